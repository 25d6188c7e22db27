"""Recording a live bus: every frame into a log, decoded signals and estimates into a measurement file.

Each file has a writer with a thread and a bounded queue of its own (`background`), so that nothing waits for a
disk; `tap` is the observer of a runner that feeds them and tells them of gaps.
"""
