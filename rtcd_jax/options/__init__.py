"""Command line → checked options, by tyro. Overrides are merged into the YAML's mapping and validated as one."""
