"""`ipmsm-can monitor`: one screen of a running drive, with keys.

What the receiving thread pays is a few microseconds a block (`course`, `taking`); findings are made in a thread of
their own (`watch`), keys are read in another (`keys`, `control`), and the drawing is done by another process
(`drawing`, `picture`, `chart`), which gets a `status` some times a second.
"""
