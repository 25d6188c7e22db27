"""Every format without a reader of its own, through python-can: one Python object per frame, so slowly."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, cast

from ipmsm_can.bus.pythoncan import block_from_messages
from ipmsm_can.frames import FrameBlock
from ipmsm_can.logs.marks import from_comments, note
from ipmsm_can.logs.savvycan import csv_reader
from ipmsm_can.logs.source import LogError, Outcome, Request, Source, unpacked_file, words_of

if TYPE_CHECKING:
    import can


def check_kind(request: Request, own: Sequence[str]) -> None:
    """Raise LogError for a suffix that neither python-can nor one of our `own` readers knows."""
    from can.io.player import MESSAGE_READERS

    if request.kind not in MESSAGE_READERS:
        raise LogError(f"{request.path} has the suffix {request.kind!r}; allowed are "
                       f"{', '.join(sorted({*MESSAGE_READERS, *own}))}, with or without .gz")


def read_other(request: Request, outcome: Outcome) -> Iterator[FrameBlock]:
    """Blocks of a log of any format python-can knows.  Raises LogError where it cannot be read at all."""
    import can
    from can.io.generic import TextIOMessageReader
    from can.io.player import MESSAGE_READERS

    reader: Any = MESSAGE_READERS[request.kind]
    if not issubclass(reader, TextIOMessageReader):
        with unpacked_file(request) as path:
            yield from _blocks(lambda: can.LogReader(path), request, outcome, None)
        outcome.done = 1.0
        return
    with Source(request.path, request.packed) as source:
        lines = _WholeLines(source, outcome)
        opening = {".asc": _asc_reader, ".csv": csv_reader}.get(request.kind, reader)
        yield from _blocks(lambda: opening(lines), request, outcome, source)
        if lines.rest:
            outcome.problem = outcome.problem or (
                f"{request.path} is cut off: its last line has no end and is left out")
        elif lines.open_block:
            outcome.problem = outcome.problem or f"{request.path} is cut off: it has no line 'End TriggerBlock'"
    outcome.done = 1.0


def _asc_reader(lines: _WholeLines) -> Any:
    """Time stamps since 1970 where the file tells its date in words that python-can knows, else from 0."""
    import can

    reader: Any = can.ASCReader(lines, relative_timestamp=False)
    known = reader._datetime_to_timestamp

    def start(words: str) -> float:
        try:
            since: float = known(words)
            return since
        except ValueError:
            return 0.0

    reader._datetime_to_timestamp = start
    return reader


def _blocks(opening: Any, request: Request, outcome: Outcome, source: Source | None) -> Iterator[FrameBlock]:
    waiting: list[can.Message] = []
    reader: Any = None
    try:
        reader = opening()
        for message in reader:
            if request.channel is not None and str(message.channel) != request.channel:
                continue
            waiting.append(message)
            if len(waiting) == request.block_frames:
                outcome.done = source.done if source else 0.0
                yield block_from_messages(waiting)
                waiting = []
    except Exception as error:  # every format's reader raises what it likes
        outcome.problem = f"{request.path} cannot be read as {request.kind}: {words_of(error)}"
    finally:
        if reader is not None:
            reader.stop()
    if waiting:
        yield block_from_messages(waiting)


class _WholeLines(io.TextIOWrapper):
    """The lines of a text that have an end: half a line of python-can's formats reads like a shorter frame.

    Remarks among them go to the outcome.  rest: a last line without an end, "" if there is none.
    open_block: an ASC file's block was begun, not ended.
    """

    def __init__(self, source: Source, outcome: Outcome) -> None:
        super().__init__(cast("io.BufferedReader", source.stream), encoding="utf-8", errors="replace")
        self.rest = ""
        self.open_block = False
        self._outcome = outcome

    def __next__(self) -> str:  # type: ignore[override]  # typeshed has it yield bytes here
        line = super().__next__()
        if line[0] in "/;":
            note(self._outcome.marks, from_comments(line.encode()))
        if line[0] in "BEbe":
            words = line.lower().split(maxsplit=2)[:2]
            self.open_block = words == ["begin", "triggerblock"] or (
                self.open_block and words != ["end", "triggerblock"])
        if not line.endswith("\n") and line.lower().split() != ["end", "triggerblock"]:
            self.rest = line
            raise StopIteration
        return line
