"""Talk to the daemon from Python: messages, and a client with and without asyncio."""
