"""HTTP and WebSocket API over a Unix socket, and over TCP if the machine file configures it.

sockets.py   creates the listening sockets
guard.py     the policy of a listener, applied before a request reaches a route
app.py       the application, its description, metrics and health
routes/      the requests and WebSockets of the API
server.py    uvicorn with limits
"""
