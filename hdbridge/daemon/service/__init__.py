"""What the service process does for clients: lease, motion queue, commissioning, jobs."""
