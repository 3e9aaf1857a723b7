"""Configuration: every default in code (`schema`); YAML files and `--set` only override (`loader`)."""
