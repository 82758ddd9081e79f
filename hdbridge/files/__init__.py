"""Files: strict YAML and CSV, atomic writing, bundled files, and error messages about invalid files."""
