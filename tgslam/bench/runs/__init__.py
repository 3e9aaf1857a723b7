"""Runs in processes of their own, each in a folder that its settings name: what studies, tables and batches share."""
