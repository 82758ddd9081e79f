"""What a test says: figures of a stepping test, several schemes side by side, accuracy by ISO 230-2."""
