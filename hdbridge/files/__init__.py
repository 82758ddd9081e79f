"""Files: strict YAML and CSV, atomic writing, bundled files, and the error messages about wrong ones."""
