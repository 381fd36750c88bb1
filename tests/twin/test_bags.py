"""Recordings in ROS bags and MCAP files are those of the same numbers as CSV."""

import gc
import warnings
from dataclasses import replace

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from jaxrod import twin
from jaxrod.files import DamagedFileError
from missing import pretend_missing
from twin.made_up import drawing

TOPICS = {
    "first": "/motors:effort[0]",
    "second": "/motors:effort[1]",
    "middle": "/middle:pose.position",
    "tip": "/tip:point",
}
KINDS = ("ros1", "sqlite3", "mcap")
BASE = 1_700_000_000_000_000_000


@pytest.fixture(autouse=True)
def files_that_rosbags_leaves_open():
    """Its writers leave files to the garbage collector, which warns."""
    yield
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)
        gc.collect()


def arm():
    """An arm with two inputs and two markers."""
    pulls = [twin.TendonDrawing(name, 0.0, 0.008) for name in ("first", "second")]
    seen = (twin.Marker("middle", at=0.1), twin.Marker("tip", at=0.3))
    return replace(drawing(), tendons=tuple(pulls), markers=seen, topics=TOPICS)


class Bag:
    """A bag to which messages are added by topic."""

    def __init__(self, path, kind):
        self.is_2 = kind != "ros1"
        if self.is_2:
            self.types = get_typestore(Stores.ROS2_HUMBLE)
            storage = StoragePlugin[kind.upper()]
            self.writer = Writer2(path, version=9, storage_plugin=storage)
            self.pack = self.types.serialize_cdr
        else:
            self.types = get_typestore(Stores.ROS1_NOETIC)
            self.writer, self.pack = Writer1(path), self.types.serialize_ros1
        self.writer.open()
        self.topics = {}

    def made(self, kind, /, **fields):
        """A message with a header's time if `time` is given [ns]."""
        if (time := fields.pop("time", None)) is not None:
            stamp = self.made(
                "builtin_interfaces/msg/Time", sec=time // 10**9, nanosec=time % 10**9
            )
            more = {} if self.is_2 else {"seq": 0}
            fields["header"] = self.made(
                "std_msgs/msg/Header", stamp=stamp, frame_id="7", **more
            )
        return self.types.types[kind](**fields)

    def point(self, place):
        """A point."""
        x, y, z = map(float, place)
        return self.made("geometry_msgs/msg/Point", x=x, y=y, z=z)

    def add(self, topic, name, message, arrived):
        """Writes a message that arrived at a time [ns]."""
        if topic not in self.topics:
            self.topics[topic] = self.writer.add_connection(
                topic, name, typestore=self.types
            )
        self.writer.write(self.topics[topic], arrived, self.pack(message, name))

    def number(self, topic, value, arrived):
        """A number without a header."""
        name = "std_msgs/msg/Float64"
        self.add(topic, name, self.made(name, data=float(value)), arrived)

    def seen(self, topic, place, time, arrived):
        """A point with a header."""
        name = "geometry_msgs/msg/PointStamped"
        message = self.made(name, time=time, point=self.point(place))
        self.add(topic, name, message, arrived)


STAMPED = dict(first="/a:data", second="/a:data", middle="/b:point", tip="/c:point")


def stamped(path, stamps, *, pulls=None, tips=None, topics=STAMPED):
    """The recording of points that arrive at 100 Hz with such times in their headers.

    `pulls` and `tips` are the times at which inputs arrive, and those in the headers
    of the tip; by default they are those of the middle.
    """
    bag = Bag(path, "mcap")
    places = {name: text.rpartition(":")[0] for name, text in topics.items()}
    tips = stamps if tips is None else tips
    for k, (time, tip) in enumerate(zip(stamps, tips, strict=True)):
        arrived = BASE + k * 10**7
        pulled = arrived if pulls is None else pulls[k]
        bag.number("/a", k, pulled)
        bag.seen(places["middle"], (k, 0, 0), time, arrived)
        bag.seen(places["tip"], (k, 1, 1), tip, arrived)
    bag.writer.close()
    return twin.read_recording(path, replace(arm(), topics=topics))


FRAMES = 10**7 * np.arange(4)


@pytest.mark.parametrize(
    "stamps", [FRAMES + BASE, FRAMES + BASE + 10**9, 0 * FRAMES], ids=str
)
def test_times_are_those_of_headers_if_they_have_any(stamps, tmp_path):
    found = stamped(tmp_path / "log", stamps.tolist())
    np.testing.assert_allclose(found.times, 0.01 * np.arange(4), atol=1e-9)
    np.testing.assert_array_equal(found.points[:, :, 0], np.arange(4)[:, None] + [0, 0])


def test_a_header_without_a_time_has_that_of_its_arrival(tmp_path):
    found = stamped(tmp_path / "log", [BASE, 0, *(FRAMES[2:] + BASE).tolist()])
    np.testing.assert_allclose(found.times, 0.01 * np.arange(4), atol=1e-9)


def test_a_simulated_time_may_begin_at_zero(tmp_path):
    pulls = {"first": "/b:point.x", "second": "/c:point.y"}
    found = stamped(tmp_path / "log", FRAMES.tolist(), topics=STAMPED | pulls)
    np.testing.assert_allclose(found.times, 0.01 * np.arange(4), atol=1e-9)
    np.testing.assert_array_equal(found.inputs[:, 0], np.arange(4))
    np.testing.assert_array_equal(found.points[:, 0, 0], np.arange(4))


def test_topics_may_have_dots_and_colons(tmp_path):
    topics = STAMPED | {"middle": "/cam.1/a:b:point"}
    found = stamped(tmp_path / "log", (FRAMES + BASE).tolist(), topics=topics)
    np.testing.assert_array_equal(found.points[:, 0, 0], np.arange(4))


@pytest.mark.parametrize(
    ("times", "message"),
    [
        ({"stamps": FRAMES + 10**9}, "clock of '/a:data' .* not that of '/b:point'"),
        ({"tips": FRAMES + 10**9}, "clock of '/c:point' .* not that of '/b:point'"),
        ({"tips": FRAMES + BASE + 10**9}, "'/c:point' has no message within half a"),
        ({"pulls": FRAMES + BASE + 10**9}, "'/a:data' begins after the last message"),
        ({"stamps": 0 * FRAMES + BASE}, "'/b:point' has different positions at the"),
    ],
)
def test_times_that_cannot_be_compared_are_refused(times, message, tmp_path):
    given = {"stamps": FRAMES + BASE} | times
    given = {name: values.tolist() for name, values in given.items()}
    with pytest.raises(DamagedFileError, match=message):
        stamped(tmp_path / "log", **given)


def write(path, kind, points, efforts):
    """Frames at 100 Hz, whose messages arrive 3 ms late; the tip misses frame 2."""
    bag = Bag(path, kind)
    for k, effort in efforts:
        time = BASE + k * 10**7
        none = {"name": [], "position": np.zeros(0), "velocity": np.zeros(0)}
        name = "sensor_msgs/msg/JointState"
        message = bag.made(name, time=time, effort=np.array(effort), **none)
        bag.add("/motors", name, message, time + 3_000_000)
    for k, (middle, tip) in enumerate(points):
        time = BASE + k * 10**7
        place = bag.point(middle)
        turn = bag.made("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
        pose = bag.made("geometry_msgs/msg/Pose", position=place, orientation=turn)
        name = "geometry_msgs/msg/PoseStamped"
        message = bag.made(name, time=time, pose=pose)
        bag.add("/middle", name, message, time + 3_000_000)
        if k != 2:
            name = "geometry_msgs/msg/PointStamped"
            message = bag.made(name, time=time + 2_000_000, point=bag.point(tip))
            bag.add("/tip", name, message, time + 3_000_000)
    bag.writer.close()


POINTS = np.random.default_rng(0).normal(size=(5, 2, 3))


@pytest.mark.parametrize("kind", KINDS)
def test_bags_hold_what_was_written(kind, tmp_path):
    path = tmp_path / ("log.bag" if kind == "ros1" else "log")
    write(path, kind, POINTS, [(0, (1.0, 2.0)), (3, (4.0, 5.0))])
    found = twin.read_recording(path, arm())
    assert found.name == "log" and found.labelled
    np.testing.assert_allclose(found.times, 0.01 * np.arange(5), atol=1e-12)
    np.testing.assert_array_equal(found.inputs[:, 0], [1, 1, 1, 4, 4])
    np.testing.assert_array_equal(found.inputs[:, 1], [2, 2, 2, 5, 5])
    seen = POINTS.copy()
    seen[2, 1] = np.nan
    np.testing.assert_array_equal(found.points, seen)


def test_a_file_of_mcap_is_read_without_its_folder(tmp_path):
    write(tmp_path / "log", "mcap", POINTS, [(0, (1.0, 2.0))])
    (file,) = (tmp_path / "log").glob("*.mcap")
    moved = file.rename(tmp_path / "alone.mcap")
    found = twin.read_recording(moved, arm())
    np.testing.assert_array_equal(found.points[:, 0], POINTS[:, 0])


def test_names_that_are_not_those_of_markers_are_found_by_registration(tmp_path):
    write(tmp_path / "log", "sqlite3", POINTS, [(0, (1.0, 2.0))])
    topics = dict(zip(["first", "second", "a", "b"], TOPICS.values(), strict=True))
    found = twin.read_recording(tmp_path / "log", replace(arm(), topics=topics))
    assert not found.labelled and found.points.shape == (5, 2, 3)


@pytest.mark.parametrize(
    ("name", "topic", "message"),
    [
        ("tip", "/nose:point", "no topic '/nose'.*its topics are /middle, /motors"),
        ("tip", "/tip:pose.position", "no 'pose'; it has header, point$"),
        ("tip", "/tip:header", "must be a point with x, y and z, got"),
        ("tip", "/tip", "must be TOPIC:FIELD"),
        ("first", "/motors:effort[7]", r"there is no 7; it has 2 entries"),
        ("middle", "/tip:point", "middle and tip have the same topic, '/tip:point'"),
        ("first", "/motors:effort", "must be a number, got ndarray"),
        ("first", "/motors:header.frame_id", "must be a number, got str"),
        ("middle", "/middle:pose.orientation", "a point with x, y and z, got .*Quat"),
    ],
)
def test_wrong_topics_are_named(name, topic, message, tmp_path):
    write(tmp_path / "log", "sqlite3", POINTS, [(0, (1.0, 2.0))])
    wrong = replace(arm(), topics=TOPICS | {name: topic})
    with pytest.raises(DamagedFileError, match=message):
        twin.read_recording(tmp_path / "log", wrong)


def transforms(path, children):
    """The recording of transforms at 100 Hz, all of which arrive a second late."""
    bag = Bag(path, "mcap")
    for k, child in enumerate(children):
        time, late = BASE + k * 10**7, BASE + 10**9 + k
        turn = bag.made("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
        place = bag.made("geometry_msgs/msg/Vector3", x=float(k), y=0.0, z=0.0)
        both = {"translation": place, "rotation": turn}
        moved = bag.made("geometry_msgs/msg/Transform", **both)
        name = "geometry_msgs/msg/TransformStamped"
        one = bag.made(name, time=time, child_frame_id=child, transform=moved)
        name = "tf2_msgs/msg/TFMessage"
        bag.add("/tf", name, bag.made(name, transforms=[one]), late)
        bag.number("/a", 0.0, BASE)
        bag.seen("/c", (0, 0, 0), time, late)
    bag.writer.close()
    topics = STAMPED | {"middle": "/tf:transforms[0].transform.translation"}
    return twin.read_recording(path, replace(arm(), topics=topics))


def test_times_are_those_of_headers_within_a_message(tmp_path):
    found = transforms(tmp_path / "log", 4 * ["middle"])
    np.testing.assert_allclose(found.times, 0.01 * np.arange(4), atol=1e-9)


def test_a_topic_of_several_transforms_is_refused(tmp_path):
    with pytest.raises(DamagedFileError, match="has transforms of middle and of tip"):
        transforms(tmp_path / "log", 2 * ["middle", "tip"])


def test_what_is_missing_is_named(tmp_path, monkeypatch):
    (log := tmp_path / "log.mcap").write_bytes(b"not a bag")
    with pytest.raises(DamagedFileError, match=r"log\.mcap: the arm has no .*'first'"):
        twin.read_recording(log, replace(arm(), topics={"tip": "/tip:point"}))
    with pytest.raises(DamagedFileError, match=r"log\.mcap is damaged"):
        twin.read_recording(log, arm())
    with pytest.raises(DamagedFileError, match="a folder without metadata"):
        twin.read_recording(tmp_path, arm())
    for absent in ("none.mcap", "none.bag"):
        with pytest.raises(FileNotFoundError, match=absent):
            twin.read_recording(tmp_path / absent, arm())
    with pytest.raises(ValueError, match="topics must be a table, got 'tip'"):
        replace(arm(), topics="tip")
    pretend_missing(monkeypatch, "rosbags")
    with pytest.raises(ImportError, match=r'pip install "jaxrod\[ros\]"'):
        twin.read_recording(tmp_path / "log.mcap", arm())
