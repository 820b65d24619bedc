"""Evaluation: scenarios, roll-outs, figures of merit, figures."""
