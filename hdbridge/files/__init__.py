"""File handling: strict YAML, CSV, EDS, atomic writing, bundled files, and messages about invalid files."""
