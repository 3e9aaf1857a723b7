"""Readers of recordings, one module a layout; docs/recordings.md lists them."""
