"""Work of the service process for clients: lease, motion queue, SDO access, loan of the bus."""
