"""Files: strict YAML and CSV, atomic writing, what comes with hdbridge, and what is said of a wrong one."""
