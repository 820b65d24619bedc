"""Evaluation: scenarios that training never sees, roll-outs, figures of merit, baselines, sweeps, stability, report."""
