"""Recorded buses: logs of every usual format as blocks of frames, and blocks as logs.

    for block in read_log("run.blf"):      # .asc .blf .csv .db .log .mf4 .trc, each packed with .gz or not
        ...                                # FrameBlock, at most 65536 frames

BLF, candump's text and MF4 are read into arrays without a Python object per frame; python-can reads the others.
"""

from ipmsm_can.logs.marks import Gap, Mark, gaps
from ipmsm_can.logs.reader import LogReader, read_log
from ipmsm_can.logs.source import LogError
from ipmsm_can.logs.writer import LogWriter, write_log

__all__ = ["Gap", "LogError", "LogReader", "LogWriter", "Mark", "gaps", "read_log", "write_log"]
