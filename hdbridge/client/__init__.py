"""What talks to the daemon from outside: the messages, and the clients that exchange them.

Imports nothing of the daemon. `messages` needs pydantic only, the clients the extra ``hdbridge[daemon]``.
"""
