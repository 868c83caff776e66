"""The link to a Universal Robots controller: child processes, sockets with deadlines, advice."""
