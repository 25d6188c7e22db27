"""The checks, one kind of fault a module: each takes a `Case` and gives findings and what was looked at."""
