"""The service process's work for clients: lease, motion queue, commissioning, jobs."""
