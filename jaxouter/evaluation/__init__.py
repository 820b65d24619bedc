"""Evaluation: scenarios that training never sees, roll-outs, figures of merit, rivals, sweeps, certificate, report."""
