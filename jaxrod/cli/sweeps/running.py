"""Parallel training of runs, wherever there is room, until they end or are stopped."""

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
    """A run that was submitted for training."""

    @property
    def begun(self) -> bool:
        """Whether a process trains it already."""

    def ended(self) -> Ended | None:
        """Its outcome; None while it has not ended."""

    def stop(self) -> None:
        """Asks the run to save and stop."""

    def end(self) -> None:
        """Ends it at once, if it has not ended."""


WorkT = TypeVar("WorkT", bound=Work)
PlannedT = TypeVar("PlannedT", bound=Planned)


class Place(Protocol[WorkT]):
    """A machine or cluster that trains runs."""

    @property
    def poll_seconds(self) -> float:
        """Time between two looks at the running work [s]."""

    @property
    def room(self) -> bool:
        """Whether it accepts another run."""

    def start(self, words: Sequence[str], folder: RunFolder) -> WorkT:
        """Starts a run, given the words of its command and its folder."""

    def leave(self, work: WorkT) -> None:
        """Frees the resources of a run that has ended."""


@dataclasses.dataclass
class _Running(Generic[PlannedT, WorkT]):
    """A run in progress."""

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
    """Trains runs to their ends; yields each with its outcome.

    If an interruption is requested, the running ones save and stop, and no other run
    starts.

    Args:
        runs: The runs, in the order in which they start.
        folder_of: Function that returns a run's folder. A run continues from its
            content.
        place: Machine or cluster that trains the runs.
        view: View that shows their progress.
        interruption: Request to stop.
        more: Words that are added to all commands.
    """
    waiting, told = list(runs), False
    running: list[_Running[PlannedT, WorkT]] = []
    try:
        while running or (waiting and not interruption.requested):
            while waiting and place.room and not interruption.requested:
                run = waiting.pop(0)
                folder = folder_of(run)
                work = place.start([*run.command(folder.path), *more], folder)
                running.append(_Running(run, folder, work))
            if interruption.requested and not told:
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
    """Shows the progress of a run."""
    row = last_row(one.folder) if one.work.begun else None
    if not one.shown and one.work.begun:
        one.shown = True
        view.start(one.run, int(row["env_steps"]) if row else 0)
    elif row:
        view.running(one.run, int(row["env_steps"]), reached(row))
