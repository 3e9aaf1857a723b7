"""YAML overrides by dataset family. Every default lives in `tgslam.config.schema`; a file says only what differs."""
