"""A page on which a simulation runs in real time, and one pulls on it with the mouse.

The page needs no packages: the server is that of Python, and the 3-D view is that of
the offline player. One compiled program makes a picture: it sets the numbers of all
handles, takes some steps with a spring to the mouse, and returns the positions. All of
these, the number of steps included, are traced, so that nothing is compiled later.
"""

from __future__ import annotations

import atexit
import html as markup
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import jaxrod
from jaxrod.model import Model, TimeStep, check_model
from jaxrod.viz import hand
from jaxrod.viz.handles import Controls, Handle, checked, controls_of
from jaxrod.viz.page import encode, live_page
from jaxrod.viz.recording import Axis, Recording
from jaxrod.viz.replay import Replay
from jaxrod.viz.serving import Server
from jaxrod.viz.shapes import Sphere

Law = Callable[[Any, Any, dict[str, Array]], Any]

HEAD = 12
"""Numbers at the head of a picture, before the values of the handles; see `_Show`."""
_SHARE = 0.85
"""Largest share of the time between pictures that the simulation may take [1]."""
_UNWATCHED = 3.0
"""Time without a request after which the simulation waits for one [s]."""
_SLOWEST = 1e-3
"""Smallest number of pictures per second [Hz]."""
_FARTHEST = 1e6
"""Distance beyond which a simulation has broken down, in sizes of the view [1]."""
_MOST_STEPS = 2**31 - 2**24
"""Number of steps at which a simulation starts again, because steps are int32."""


class Live:
    """A simulation that runs in real time while its page is open.

    Made by `live`. It is a context manager, which ends the page.

    Example:
        >>> with viz.live(scene, state, title="My arm", port=None) as page:
        ...     page.do({"pull": {"node": 10, "point": (1.0, 0.0, 0.2)}})
        ...     "<title>My arm" in page.page()
        1
        True
    """

    def __init__(self, show: _Show, server: Server | None) -> None:
        """Starts the simulation, and the server if there is one."""
        self._show, self._server = show, server
        if server is not None:
            server.serve(show)
        self._thread = threading.Thread(target=show.run, daemon=True)
        self._thread.start()
        # A thread inside a compiled program must not outlive the interpreter.
        atexit.register(self.stop)

    @property
    def url(self) -> str | None:
        """Address of the page; `None` without a server."""
        return None if self._server is None else self._server.url

    @property
    def values(self) -> dict[str, np.ndarray]:
        """Values of all handles now, by label."""
        return dict(self._show.values)

    @property
    def state(self) -> Any:
        """State of the scene or the system now."""
        return self._show.state

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return self._show.time

    @property
    def dt(self) -> float:
        """Step size [s]."""
        return self._show.dt

    def page(self) -> str:
        """The page that a browser gets."""
        return self._show.page()

    def do(self, command: Mapping[str, Any]) -> int:
        """Does what a page asks for, and returns the number of the command.

        Args:
            command: A dict with some of these entries. `"set"`: values by label of
                their handles. `"pull"`: `{"node": k, "point": (x, y, z)}` pulls the
                node k of all nodes to a point [m], and `None` lets go. `"paused"`:
                whether time stands still. `"reset"`: `True` starts again.

        Raises:
            ValueError: It cannot be done.
            RuntimeError: The page has ended.
        """
        return self._show.do(command)

    def picture(self, after: int = 0, patience: float = 10.0) -> dict[str, Any]:
        """The first picture after a number, as a page gets it.

        Args:
            after: Number of the last picture that is already known.
            patience: Longest wait [s].

        Returns:
            Dict with `number`, `time` [s], `pace` (simulated time per time, over the
            last second) [1], `heard` (number of the last command that it shows),
            `paused`, `failed`, `force` of the hand [N], `rate` [1/s], `values` of all
            handles in one row, and `points`, an array (points, 3) [m]: nodes of rods,
            then centres of targets, then origins of bodies.

        Raises:
            TimeoutError: There is no such picture in time.
            RuntimeError: The page has ended.
        """
        given = self._show.picture(after, patience)
        if not given:
            self._show.reraise()
            self._show.require_running()
            raise TimeoutError(
                f"no picture came after number {after} within {patience:g} s"
            )
        return self._show.unpacked(given)

    def wait(self) -> None:
        """Waits until the program is interrupted (Ctrl-C), then ends the page."""
        try:
            while self._thread.is_alive():
                self._thread.join(0.2)
        except KeyboardInterrupt:
            pass
        self.stop()
        self._show.reraise()

    def stop(self) -> None:
        """Ends the simulation and its page."""
        atexit.unregister(self.stop)
        self._show.end()
        self._thread.join()
        if self._server is not None:
            self._server.close()
            self._server = None

    def __enter__(self) -> Self:
        """The page itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Ends the page."""
        self.stop()

    def __repr__(self) -> str:
        """One line: the address, or that the page has ended."""
        return f"Live({self.url or 'no server'})"

    def _repr_html_(self) -> str:
        """HTML of the page in an iframe, which notebooks display."""
        if self.url is None:
            return f"<p>{markup.escape(repr(self))}</p>"
        return (
            f'<iframe src="{markup.escape(self.url)}" title="Live simulation" '
            'style="width:100%;height:560px;border:0;border-radius:8px"></iframe>'
        )


def live(
    model: Any,
    state: Any,
    controls: Mapping[str, Handle] | None = None,
    *,
    law: Law | None = None,
    dt: TimeStep | None = None,
    frames_per_second: float = 60.0,
    port: int | None = 0,
    title: str = "",
    up: Axis = "z",
    floor: float | None = None,
    colours: Mapping[str, str] | None = None,
) -> Live:
    """Simulates a scene or a system in real time on a page, where one pulls on it.

    Drag a rod or a body to pull on it, with the force F = k (p - x) on its nearest
    node; drag a target to move it. A gamepad does the same. If the machine is too slow
    for real time, the page says how much slower the motion is.

    Args:
        model: The scene or the system.
        state: The state to start from.
        controls: Sliders and targets by label; see `Slider` and `Target`.
        law: Function `law(model, state, values)` that returns the model to use for the
            next picture, such as a controller that follows a target. `values` are the
            values of all handles by label. It is compiled.
        dt: Step size [s], or the result of `jaxrod.stable_dt`; by default 0.9 of the
            largest stable step.
        frames_per_second: Largest number of pictures per second [Hz].
        port: Port of the page on this machine; 0 for any that is free, `None` for no
            server.
        title: Heading of the page.
        up: World axis that is drawn upwards.
        floor: Height of the drawn ground along this axis [m]; see `Replay.from_states`.
        colours: Colour of some members as "#rrggbb", by name of the member.

    Returns:
        The page. It runs until `stop()` or the end of the program; `wait()` at the end
        of a script keeps it.

    Raises:
        ValueError: An argument has the wrong shape or an impossible value.
        TypeError: `model` is neither a scene nor a system, a control is no handle, or
            `law` is no function or returns no model.
        OSError: The port is taken.

    Example:
        >>> with viz.live(scene, state, port=None) as page:
        ...     first = page.picture()
        ...     later = page.picture(first["number"])
        >>> later["time"] > first["time"]
        True
    """
    check_model(model)
    model.check_state(state)
    rate = float(checked("frames_per_second", frames_per_second, unit="Hz"))
    if not rate > 0:
        raise ValueError(f"frames_per_second must be positive, got {rate:g} Hz")
    if rate < _SLOWEST:
        raise ValueError(
            f"frames_per_second must be at least {_SLOWEST:g} Hz, got {rate:g} Hz"
        )
    if port is not None and not _is_index(port, 65536):
        raise ValueError(f"port must be an integer from 0 to 65535, got {port!r}")
    if law is not None and not callable(law):
        raise TypeError(
            f"law must be a function law(model, state, values), got {law!r}"
        )
    handles, values = controls_of(controls or {}, model)
    targets = [
        Sphere(values[label], float(radius), label)
        for label, radius in _radii(handles).items()
    ]
    replay = Replay.from_states(
        model,
        jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], state),
        [0.0],
        colours=colours,
        up=up,
        floor=floor,
        spheres=targets,
        title=title,
    )
    # Compiling takes seconds: take the port first.
    server = None if port is None else Server(port)
    try:
        show = _Show(model, state, handles, values, law, dt, rate, replay)
    except BaseException:
        if server is not None:
            server.close()
        raise
    page = Live(show, server)
    if page.url is not None:
        print(page.url, flush=True)
    return page


def _lawful(changed: Any) -> Any:
    """A model that a law has returned; raises a TypeError if it is none."""
    if not callable(getattr(changed, "interfaces", None)):
        raise TypeError(
            f"law must return a scene or a system, got {type(changed).__name__}"
        )
    return changed


def _is_index(value: Any, count: int) -> bool:
    """Whether a value is an integer from 0 to `count - 1`."""
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    return whole and 0 <= value < count


def _radii(controls: Controls) -> dict[str, float]:
    """Radii of the targets, by label [m]."""
    given = {label: handle.radius for label, handle in controls.handles.items()}
    return {label: radius for label, radius in given.items() if radius is not None}


class _Show:
    """A simulation, its commands and its latest picture, without a server."""

    def __init__(
        self,
        model: Model,
        state: Any,
        controls: Controls,
        values: dict[str, np.ndarray],
        law: Law | None,
        dt: TimeStep | None,
        rate: float,
        replay: Recording,
    ) -> None:
        self.controls, self.values = controls, values
        self._replay = replay
        self._box = _room(replay)
        self._model = model
        self._size = float(np.linalg.norm(self._box[1] - self._box[0]))
        stiffness = hand.stiffnesses(model, self._size)
        self._stiffness = {name: float(k) for name, k in stiffness.items()}
        grips = hand.no_grip(model)
        self._free, self._grips = grips, grips
        self._rows = {name: own.size for name, own in grips.items()}
        self._dtype = next(iter(model.interfaces().values())).dtype
        held = hand.with_hand(model, grips, jnp.zeros(3, self._dtype), stiffness)
        if dt is None:
            dt = 0.9 * held.stable_step(1.0).dt
        self._step = model.check_run(state, dt, None)
        self.dt = float(self._step)
        self._start = model.with_memory(state)
        self.state, self._steps = self._start, 0
        self._period = 1 / rate
        self._template = _series(replay)
        self._nodes = sum(r.num_rods * r.num_nodes for r in replay.rods)
        self._bodies = self._nodes + len(replay.spheres)
        moving = self._template[0][self._bodies :][
            : sum(self._rows.values()) - self._nodes
        ]
        # Positions of the last good picture.
        self._seen = (
            np.concatenate([self._template[0][: self._nodes], moving]),
            self._template[1][: len(moving)],
        )
        self._pull: tuple[int, str, np.ndarray] | None = None
        self.paused, self.failed = False, False
        self._error: BaseException | None = None
        self._commands: list[tuple[int, dict[str, Any]]] = []
        self._asked, self._heard, self._number = 0, 0, 0
        self._news = threading.Condition()
        self._ended = threading.Event()
        self._picture = b""
        self._watched, self._waiting = time.perf_counter(), 0
        self._past: deque[tuple[float, float, int]] = deque()
        self._cost = math.inf
        self._due_steps = 0.0
        self._program = self._compiled(law, stiffness)

    # What a page sees.

    def page(self) -> str:
        """The page."""
        header, data = encode(self._replay)
        header["box"] = [corner.tolist() for corner in self._box]
        header["head"] = HEAD
        header["moving"] = sum(self._rows.values()) - self._nodes
        header["firm"] = self._size
        header["handles"] = [
            {
                "label": label,
                "value": self.values[label].tolist(),
                "range": [end.tolist() for end in handle.ends(self._box)],
                "radius": handle.radius,
            }
            for label, handle in self.controls.handles.items()
        ]
        return live_page(header, data)

    @property
    def ended(self) -> bool:
        """Whether there will be no more pictures."""
        return self._ended.is_set()

    def picture(self, after: int, patience: float) -> bytes:
        """The first picture after number `after`, empty if there is none in time.

        It has, as float64, its number, the time [s], the pace, the number of the last
        command it shows, whether time stands still, whether the simulation has failed,
        the point that is held or -1, the position of the hand (3) [m], its force [N],
        and the number of pictures per second; then the values of all handles. As
        float32 follow all points, orientations and arrows, as in `encode`.
        """
        with self._news:
            self._watched = time.perf_counter()
            self._news.notify_all()
            ready = lambda: self._number > after or self._ended.is_set()
            self._waiting += 1
            try:
                self._news.wait_for(ready, patience)
            finally:
                self._waiting -= 1
                self._watched = time.perf_counter()
            return self._picture if self._number > after else b""

    def unpacked(self, picture: bytes) -> dict[str, Any]:
        """The numbers of a picture, by name."""
        count = HEAD + sum(value.size for value in self.values.values())
        head = np.frombuffer(picture, "<f8", count)
        series = np.frombuffer(picture, "<f4", offset=8 * count)
        points = self._template[0].shape[0]
        return {
            "number": int(head[0]),
            "time": float(head[1]),
            "pace": float(head[2]),
            "heard": int(head[3]),
            "paused": bool(head[4]),
            "failed": bool(head[5]),
            "force": float(head[10]),
            "rate": float(head[11]),
            "values": head[HEAD:],
            "points": series[: 3 * points].reshape(-1, 3),
        }

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return self._steps * self.dt

    def do(self, command: Any) -> int:
        """Checks a command and puts it in the queue; returns its number."""
        checked = self._checked(command)
        self.require_running()
        with self._news:
            self._asked += 1
            self._commands.append((self._asked, checked))
            return self._asked

    def _checked(self, command: Any) -> dict[str, Any]:
        if not isinstance(command, Mapping) or not command:
            raise ValueError("a command must be a dict with set, pull, paused or reset")
        checked: dict[str, Any] = {}
        for key, given in command.items():
            if key in ("paused", "reset"):
                if given not in (True, False):
                    raise ValueError(f"{key} must be true or false, got {given!r}")
                checked[key] = bool(given)
            elif key == "set":
                checked[key] = self._checked_values(given)
            elif key == "pull":
                checked[key] = None if given is None else self._checked_pull(given)
            else:
                raise ValueError(
                    f"a command is set, pull, paused or reset, got {key!r}"
                )
        return checked

    def _checked_values(self, given: Any) -> dict[str, np.ndarray]:
        if not isinstance(given, Mapping):
            raise ValueError(f"set must be a dict of values by label, got {given!r}")
        values = {}
        for label, value in given.items():
            if label not in self.controls.handles:
                raise ValueError(
                    f"there is no control {label!r}; there are "
                    + ", ".join(map(repr, self.controls.handles))
                )
            values[label] = self.controls.handles[label].checked(label, value)
        return values

    def _checked_pull(self, given: Any) -> tuple[int, str, np.ndarray]:
        if not isinstance(given, Mapping) or set(given) != {"node", "point"}:
            raise ValueError(f"pull must be a dict of node and point, got {given!r}")
        total = sum(self._rows.values())
        node, point = given["node"], checked("point", given["point"], (3,), "m")
        if not _is_index(node, total):
            raise ValueError(
                f"node must be an integer from 0 to {total - 1}, got {node!r}"
            )
        node = int(node)
        return node, self._owner(node)[0], point

    def _owner(self, node: int) -> tuple[str, int]:
        """Name of the member of a node, and the node's index in that member."""
        index = node
        for name, count in self._rows.items():
            if index < count:
                return name, index
            index -= count
        raise AssertionError("there is no such node")

    # The simulation, in its own thread.

    def run(self) -> None:
        """Makes pictures until the end."""
        due = time.perf_counter()
        try:
            while not self._ended.is_set():
                self._obey()
                self._advance()
                due = max(due + self._period, time.perf_counter())
                self._rest(due)
        except BaseException as error:
            self._error = error
            self.end()

    def end(self) -> None:
        """Ends the simulation after the present picture."""
        with self._news:
            self._ended.set()
            self._news.notify_all()

    def require_running(self) -> None:
        """Raises a RuntimeError after the end."""
        if self.ended:
            raise RuntimeError("the page has ended: viz.live makes a new one")

    def reraise(self) -> None:
        """Raises the error that has ended the simulation, if there was one."""
        if self._error is not None:
            raise self._error

    def _rest(self, due: float) -> None:
        """Waits until a time, and then until somebody looks."""
        self._ended.wait(max(0.0, due - time.perf_counter()))
        with self._news:
            looked = lambda: (
                self._ended.is_set()
                or self._waiting > 0
                or time.perf_counter() - self._watched < _UNWATCHED
            )
            if not looked():
                self._news.wait_for(looked)
                self._past.clear()

    def _obey(self) -> None:
        with self._news:
            commands, self._commands = self._commands, []
        for number, command in commands:
            self._heard = number
            self.paused = command.get("paused", self.paused)
            self.values = self.values | command.get("set", {})
            if "pull" in command:
                self._hold(command["pull"])
            if command.get("reset"):
                self._begin_again()

    def _hold(self, pull: tuple[int, str, np.ndarray] | None) -> None:
        if pull is None:
            self._grips = self._free
        elif self._pull is None or self._pull[0] != pull[0]:
            self._grips = hand.grip_at(self._model, *self._owner(pull[0]))
        self._pull = pull

    def _begin_again(self) -> None:
        self.state, self._steps, self.failed = self._start, 0, False
        self._past.clear()

    def _advance(self) -> None:
        """Takes the steps up to the next picture, and publishes it."""
        count = 0 if self.paused or self.failed else self._count()
        begun = time.perf_counter()
        point = np.zeros(3) if self._pull is None else self._pull[2]
        values = {k: v.astype(self._dtype) for k, v in self.values.items()}
        state, points, turns = self._program(
            self._model,
            self.state,
            np.int32(count),
            np.int32(self._steps),
            values,
            self._grips,
            point.astype(self._dtype),
        )
        points, turns = np.asarray(points), np.asarray(turns)
        now = time.perf_counter()
        if count:
            self._cost = (now - begun) / count
        far = np.abs(points).max(initial=0.0)
        if far < _FARTHEST * self._size and np.isfinite(turns).all():
            self.state, self._steps = state, self._steps + count
        else:
            # The last good state stays in view.
            self.failed = True
            points, turns = self._seen
        self._seen = points, turns
        if self._steps > _MOST_STEPS:
            self._begin_again()
        self._publish(points, turns, now)

    def _count(self) -> int:
        """Number of steps for this picture: real time, or what there is time for."""
        self._due_steps += self._period / self.dt
        wanted = int(self._due_steps)
        self._due_steps -= wanted
        most = max(1, int(_SHARE * self._period / self._cost))
        return min(wanted, most)

    def _publish(self, points: np.ndarray, turns: np.ndarray, now: float) -> None:
        self._past.append((now, self.time, self._number))
        while len(self._past) > 2 and now - self._past[0][0] > 1.0:
            self._past.popleft()
        then, was, number = self._past[0]
        elapsed = now - then
        pace = (self.time - was) / elapsed if elapsed > 0 else 0.0
        rate = (self._number - number) / elapsed if elapsed > 0 else 0.0
        whole, poses, _ = self._template
        moving = len(points) - self._nodes
        whole[: self._nodes] = points[: self._nodes]
        for k, label in enumerate(_radii(self.controls)):
            whole[self._nodes + k] = self.values[label]
        whole[self._bodies : self._bodies + moving] = points[self._nodes :]
        poses[:moving] = turns
        held, way, force = -1, np.zeros(3), 0.0
        if self._pull is not None:
            node, name, way = self._pull
            force = self._stiffness[name] * float(np.linalg.norm(way - points[node]))
            held = node if node < self._nodes else node + len(self._replay.spheres)
        head = [self._number + 1, self.time, pace, self._heard, self.paused]
        head += [self.failed, held, *way, force, rate]
        head += [float(x) for value in self.values.values() for x in np.ravel(value)]
        series = np.concatenate([np.ravel(part) for part in self._template])
        packed = np.asarray(head, "<f8").tobytes() + series.astype("<f4").tobytes()
        with self._news:
            self._number += 1
            self._picture = packed
            self._news.notify_all()

    def _compiled(self, law: Law | None, stiffness: dict[str, Array]) -> Any:
        """The program of a picture, compiled ahead: it never compiles again."""
        evolves, dt, controls = self._model.evolves, self._step, self.controls

        def picture(
            model: Any,
            state: Any,
            count: Array,
            first: Array,
            values: dict[str, Array],
            grips: dict[str, Array],
            point: Array,
        ) -> Any:
            changed = controls.applied(model, values)
            if law is not None:
                changed = _lawful(law(changed, state, values))
            held = hand.with_hand(changed, grips, point, stiffness)
            begin = first if evolves else 0
            begun = hand.with_memory_of(held, state)
            after = jaxrod.advance(held, begun, dt, count, first=begin)
            after = hand.with_memory_of(model, after)
            return after, *_places(model, after, self._dtype)

        values = {k: v.astype(self._dtype) for k, v in self.values.items()}
        point, none = np.zeros(3, self._dtype), np.int32(0)
        given = (self._model, self._start, none, none, values, self._free, point)
        return jax.jit(picture).lower(*given).compile()


def _places(model: Model, state: Any, dtype: Any) -> tuple[Array, Array]:
    """Nodes of rods, then origins of bodies (points, 3); orientations (bodies, 4)."""
    own = model.states_by_name(state)
    rows, turns = [jnp.zeros((0, 3), dtype)], [jnp.zeros((0, 4), dtype)]
    for name, member in hand.movable(model).items():
        rows.append(jnp.moveaxis(own[name].positions, -2, -1).reshape(-1, 3))
        if member.rod is None:
            turns.append(jnp.moveaxis(own[name].orientations, -2, -1).reshape(-1, 4))
    return jnp.concatenate(rows), jnp.concatenate(turns)


def _series(replay: Recording) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (P, 3), orientations (B, 4) and arrows (0, 3) of the first frame."""
    points = [rods.positions[0].reshape(-1, 3) for rods in replay.rods]
    points += [sphere.positions[:1] for sphere in replay.spheres]
    points += [mesh.positions[0] for mesh in replay.meshes]
    turns = [mesh.orientations[0] for mesh in replay.meshes]
    none = np.zeros((0, 3)), np.zeros((0, 4))
    return (
        np.concatenate([*points, none[0]]),
        np.concatenate([*turns, none[1]]),
        none[0],
    )


def _room(replay: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Box that the view shows: what is there, and as much beside it as it is long."""
    low, high = replay.bounds()
    middle = (low + high) / 2
    half = np.maximum((high - low) / 2, 0.4 * float(np.max(high - low)))
    low, high = middle - half, middle + half
    if replay.floor is not None:
        axis = "xyz".index(replay.up)
        low[axis] = max(low[axis], replay.floor)
    return low, high
