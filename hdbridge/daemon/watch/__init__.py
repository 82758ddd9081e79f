"""Load-encoder watch: monitors the validity of the model and the health of the load encoder."""
