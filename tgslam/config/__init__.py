"""Configuration: frozen dataclasses with every default in code (`schema`); YAML files and `--set` only override (`loader`)."""
