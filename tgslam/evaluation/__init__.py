"""Metrics: trajectory errors against ground truth, and rendered images against measured ones."""
