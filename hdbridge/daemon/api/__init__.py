"""HTTP and WebSocket over a Unix socket, and over TCP where the machine file says so.

sockets.py   the listening sockets, bound here
policy.py    who may ask what on one listener
guard.py     holds every request to it before a route sees it
app.py       the application, its description, metrics and health
routes/      what may be asked
server.py    uvicorn under it, bounded
"""
