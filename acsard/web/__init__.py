"""The server of the robot's page, `acsard web`: a process of its own, and a client of the daemon.

`connections.py` accepts connections, `access.py` decides who may do what, and `app.py` has all
paths (`ROUTES`) and answers them. `viewer.py` serves a WebSocket; whatever ends it ends its motion,
in `Viewer._release`. A STOP goes to the daemon through `calls.py`. `page_server.py` starts
everything, and reads tokens and certificate once a second.
"""
