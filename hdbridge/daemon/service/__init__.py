"""The service process's work for clients: lease, motion queue, SDO access, loan of the bus."""
