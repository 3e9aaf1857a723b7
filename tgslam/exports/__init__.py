"""What a run has found, written for other programs: one module a format, listed in `export_formats`."""
