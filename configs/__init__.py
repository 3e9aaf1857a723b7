"""YAML overrides by dataset family. Every default lives in `tgslam.config.schema`; these files say only what differs."""
