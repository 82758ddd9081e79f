"""What a bench does with an axis, as pure generators."""
