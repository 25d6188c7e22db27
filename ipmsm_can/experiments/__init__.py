"""The paper's experiments as data, run through the simulated drive and the wire, judged, and put on one page."""
