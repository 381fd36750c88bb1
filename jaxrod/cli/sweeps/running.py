"""Runs trained side by side, wherever there is room, to their ends or to a stop."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Generic, Protocol, TypeVar

from jaxrod.cli.sweeps.planned import Planned
from jaxrod.cli.sweeps.process import Ended, last_row
from jaxrod.cli.sweeps.view import RunsView, reached
from jaxrod.training import RunFolder
from jaxrod.training.runs.interruption import Interruption


class Work(Protocol):
    """A run that was handed over to be trained."""

    @property
    def begun(self) -> bool:
        """Whether a process trains it by now."""

    def ended(self) -> Ended | None:
        """How it ended; None while it has not."""

    def stop(self) -> None:
        """Lets it save and stop."""

    def end(self) -> None:
        """Ends it at once, if it has not ended."""


WorkT = TypeVar("WorkT", bound=Work)
PlannedT = TypeVar("PlannedT", bound=Planned)


class Place(Protocol[WorkT]):
    """Where runs are trained."""

    @property
    def poll_seconds(self) -> float:
        """How often to look at what is under way [s]."""

    @property
    def room(self) -> bool:
        """Whether it takes another run."""

    def start(self, words: Sequence[str], folder: RunFolder) -> WorkT:
        """Takes a run: the words of its command, and its folder."""

    def leave(self, work: WorkT) -> None:
        """A run has ended."""


@dataclasses.dataclass
class _Running(Generic[PlannedT, WorkT]):
    """A run that is under way."""

    run: PlannedT
    folder: RunFolder
    work: WorkT
    shown: bool = False


def train_all(
    runs: Sequence[PlannedT],
    folder_of: Callable[[PlannedT], RunFolder],
    place: Place[WorkT],
    view: RunsView,
    interruption: Interruption,
    more: Sequence[str] = (),
) -> Iterator[tuple[PlannedT, Ended]]:
    """Trains runs to their ends; yields each, and how its process ended.

    When an interruption is asked for, those that are under way save and stop, and no
    other starts.

    Args:
        runs: In the order in which they start.
        folder_of: Where each is trained. What is there is gone on with.
        place: Where the processes are.
        view: Shows how far they are.
        interruption: May ask to stop.
        more: Words that all the commands get.
    """
    waiting, told = list(runs), False
    running: list[_Running[PlannedT, WorkT]] = []
    try:
        while running or (waiting and not interruption.asked):
            while waiting and place.room and not interruption.asked:
                run = waiting.pop(0)
                folder = folder_of(run)
                work = place.start([*run.command(folder.path), *more], folder)
                running.append(_Running(run, folder, work))
            if interruption.asked and not told:
                told = True
                for one in running:
                    one.work.stop()
            for one in list(running):
                ended = one.work.ended()
                if ended is None:
                    _show(one, view)
                    continue
                one.work.end()
                running.remove(one)
                place.leave(one.work)
                yield one.run, ended
            time.sleep(place.poll_seconds)
    finally:
        for one in running:
            one.work.end()


def _show(one: _Running[PlannedT, WorkT], view: RunsView) -> None:
    """Shows how far a run is."""
    row = last_row(one.folder) if one.work.begun else None
    if not one.shown and one.work.begun:
        one.shown = True
        view.start(one.run, int(row["env_steps"]) if row else 0)
    elif row:
        view.running(one.run, int(row["env_steps"]), reached(row))
