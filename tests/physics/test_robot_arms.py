"""Robot arms from files: their poses, and the ends of rods that they drive."""

import sys
from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import jaxrod
from jaxrod import schedules
from jaxrod.geometry.rotations import directors_from_orientations

URDF = """<robot name="reacher">
  <link name="base"><visual><geometry><mesh filename="package://none/base.stl"/>
  </geometry></visual></link>
  <link name="upper"/> <link name="lower"/> <link name="hand"/> <link name="lamp"/>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/>
    <origin xyz="0 0 0.2" rpy="0.1 0.2 0.3"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="1.5" effort="1" velocity="1"/></joint>
  <joint name="slide" type="prismatic"><parent link="upper"/><child link="lower"/>
    <origin xyz="0.1 0 0.3"/><axis xyz="0 3 4"/>
    <limit lower="-1" upper="0.2" effort="1" velocity="1"/></joint>
  <joint name="glue" type="fixed"><parent link="lower"/><child link="hand"/>
    <origin xyz="0 0 0.1" rpy="0 1.2 0"/></joint>
  <joint name="neck" type="continuous"><parent link="base"/><child link="lamp"/>
    <axis xyz="1 0 0"/></joint>
</robot>"""
MJCF = """<mujoco><compiler angle="radian"/><worldbody>
  <body name="stand" pos="0.1 0.2 0.3" euler="0.3 0 0.1">
    <geom type="mesh" mesh="none"/>
    <joint name="turn" type="hinge" axis="1 2 -1" pos="0.02 0.05 -0.1" ref="0.4"/>
    <joint name="push" type="slide" axis="0 1 1"/>
    <body name="plate" pos="0 0 0.2" quat="1 1 0 0">
      <body name="palm" pos="0.3 0 0">
        <joint name="bend" axis="0 0 1" pos="-0.05 0 0" range="-2 2"/>
        <site name="finger" pos="0.01 0.02 0.03" euler="0 0.5 0"/>
      </body></body></body>
</worldbody><asset><mesh name="none" file="none.stl"/></asset></mujoco>"""
ROD = {"length": 0.3, "radius": 0.01, "density": 1000.0, "youngs_modulus": 1e6}


def written(folder, text, name="robot.xml"):
    file = folder / name
    file.write_text(text)
    return file


def crane(folder, joints, more=""):
    """An arm of one body with these joints."""
    body = f'<body name="hook" pos="0.1 0 0.2">{joints}{more}</body>'
    text = f"<mujoco><worldbody>{body}</worldbody></mujoco>"
    return jaxrod.robot_arm(written(folder, text), "hook")


@pytest.mark.fast_sets(3)
@pytest.mark.parametrize(
    ("text", "hand", "joints"),
    [
        (URDF, "hand", ("shoulder", "slide")),
        (URDF, "lamp", ("neck",)),
        (MJCF, "palm", ("turn", "push", "bend")),
        (MJCF, "plate", ("turn", "push")),
        (MJCF, "finger", ("turn", "push", "bend")),
    ],
)
def test_poses_are_those_of_mujoco(tmp_path, text, hand, joints):
    file = written(tmp_path, text)
    arm = jaxrod.robot_arm(file, hand)
    assert arm.joints == joints
    # Their own reader, without the meshes, which are missing.
    spec = mujoco.MjSpec.from_file(str(file))
    spec.compiler.fusestatic, spec.compiler.boundmass = False, 1.0
    spec.compiler.boundinertia = 1.0
    for one in [*spec.geoms, *spec.meshes]:
        spec.delete(one)
    model = spec.compile()
    data = mujoco.MjData(model)
    draws = np.random.default_rng(0).uniform(-2, 2, (20, len(joints)))
    places, turns = jax.jit(jax.vmap(arm.pose))(draws)
    frames = directors_from_orientations(turns.T)
    for k, coordinates in enumerate(draws):
        for name, value in zip(joints, coordinates, strict=True):
            data.joint(name).qpos[0] = value
        mujoco.mj_kinematics(model, data)
        frame = data.site(hand) if hand == "finger" else data.body(hand)
        np.testing.assert_allclose(places[k], frame.xpos, atol=1e-12)
        # Rows of one matrix are columns of the other.
        theirs = frame.xmat.reshape(3, 3).T
        np.testing.assert_allclose(frames[..., k], theirs, atol=1e-12)


def test_the_base_may_stand_anywhere(tmp_path):
    file, there = written(tmp_path, URDF), (0.1, -0.2, 0.3)
    at, q = jnp.array([0.3, -0.2]), (0.0, 0.0, 0.0, 2.0)  # half a turn about z
    moved = jaxrod.robot_arm(file, "hand", position=there, orientation=q)
    x, y, z = jaxrod.robot_arm(file, "hand").pose(at)[0]
    np.testing.assert_allclose(
        moved.pose(at)[0], jnp.array([-x, -y, z]) + np.array(there)
    )


def test_limits_are_those_of_the_file(tmp_path):
    arm = jaxrod.robot_arm(written(tmp_path, MJCF), "palm")
    assert arm.lower.tolist() == [-np.inf, -np.inf, -2.0]
    assert arm.upper.tolist() == [np.inf, np.inf, 2.0]
    assert arm.references.tolist() == [0.4, 0.0, 0.0]


def test_derivatives_are_those_of_differences(tmp_path):
    """Derivatives by the coordinates, and by the geometry, which is traced as well."""
    arm = jaxrod.robot_arm(written(tmp_path, MJCF), "finger")
    at, step = jnp.array([0.3, -0.2, 0.7]), 1e-6

    def number(coordinates, places):
        place, turn = replace(arm, places=places).pose(coordinates)
        return jnp.sum(jnp.sin(place)) + turn[1] * turn[2]

    slopes = jax.jit(jax.grad(number, (0, 1)))(at, arm.places)
    points = at, arm.places
    for which, slope in enumerate(slopes):
        way = jnp.asarray(np.random.default_rng(1).normal(size=slope.shape))

        def along(t, which=which, way=way):
            moved = list(points)
            moved[which] = moved[which] + t * way
            return number(*moved)

        difference = (along(step) - along(-step)) / (2 * step)
        np.testing.assert_allclose(jnp.sum(slope * way), difference, rtol=1e-7)


@pytest.mark.slow
def test_an_end_follows_the_hand_with_its_rates(tmp_path):
    """An end that is held beside the hand, by a table of the coordinates."""
    arm = jaxrod.robot_arm(written(tmp_path, MJCF), "finger")
    _, state = jaxrod.straight_rod(4, start=(0.4, 0.1, 0.2), **ROD)
    swing = schedules.sine(jnp.array([0.5, 0.1, -0.7]), 1.0, phase=0.1)
    held = arm.hold(state, swing, "tip")

    rod = jaxrod.straight_rod(4, **ROD)[0]
    scene = jaxrod.make_scene(rod, held)
    at = jax.jit(lambda time: scene.at(time).effects[0])
    np.testing.assert_allclose(at(0.0).place.position, state.tip, atol=1e-12)
    np.testing.assert_allclose(
        at(0.0).turn.orientation, state.orientations[:, -1], atol=1e-12
    )
    h = 1e-4
    before, now, after = (at(t) for t in (0.3 - h, 0.3, 0.3 + h))

    def rate(part):
        return (part(after) - part(before)) / (2 * h)

    place, turn = now.place, now.turn
    np.testing.assert_allclose(
        place.velocity, rate(lambda e: e.place.position), rtol=1e-6
    )
    np.testing.assert_allclose(
        place.acceleration, rate(lambda e: e.place.velocity), rtol=1e-6
    )
    np.testing.assert_allclose(
        turn.angular_acceleration, rate(lambda e: e.turn.angular_velocity), rtol=1e-6
    )
    # The distance from the hand stays, and so does the angle to it.
    hand = [arm.pose(0.0 * jnp.zeros(3) + swing_at(swing, t))[0] for t in (0.0, 0.3)]
    away = [
        np.linalg.norm(at(t).place.position - p)
        for t, p in zip((0.0, 0.3), hand, strict=True)
    ]
    np.testing.assert_allclose(away[0], away[1], rtol=1e-12)
    # A frame that turns with the angular velocity: dq/dt = (0, w) q / 2.
    w, q = turn.angular_velocity, turn.orientation
    change = rate(lambda e: e.turn.orientation)
    expected = 0.5 * jnp.append(-w @ q[1:], q[0] * w + jnp.cross(w, q[1:]))
    np.testing.assert_allclose(change, expected, atol=1e-6)


def swing_at(swing, time):
    return swing(schedules.Clock(jnp.int32(0), jnp.asarray(time), jnp.asarray(1.0)))


@pytest.mark.slow
@pytest.mark.parametrize("holds_element", [False, True])
def test_a_hinge_drives_as_a_wall_that_turns_about_an_axis(tmp_path, holds_element):
    arm = crane(tmp_path, '<joint name="a" axis="0 1 0"/>')
    rod, state = jaxrod.straight_rod(4, start=(0.3, 0.0, 0.2), **ROD)
    angle = schedules.sine(jnp.asarray(0.4), 0.5)
    swing = schedules.sine(jnp.array([0.4]), 0.5)
    ours = arm.hold(state, swing, holds_element=holds_element)
    theirs = jaxrod.driven(
        state,
        axis=(0.0, 1.0, 0.0),
        angle=angle,
        about=(0.1, 0.0, 0.2),
        holds_element=holds_element,
    )
    ends = []
    for effect in (ours, theirs):
        scene = jaxrod.make_scene(rod, effect, jaxrod.gravity())
        moved = jaxrod.advance(scene, state, 2e-4, 500)
        ends.append((moved, jaxrod.reactions(scene.at(0.1), moved)[0]))
    for a, b in zip(*map(jax.tree.leaves, ends), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-11)
    assert float(ends[0][0].tip[2]) < 0.45  # It moved at all.


@pytest.mark.slow
def test_the_tip_has_derivatives_by_the_path_of_the_joints(tmp_path):
    """Through a motion, whose last coordinates are varied."""
    arm = jaxrod.robot_arm(written(tmp_path, MJCF), "finger")
    rod, state = jaxrod.straight_rod(4, start=(0.4, 0.1, 0.2), **ROD)

    def tip(last):
        swing = schedules.ramp(jnp.zeros(3), last, duration=0.05)
        scene = jaxrod.make_scene(rod, arm.hold(state, swing), jaxrod.gravity())
        return jnp.sum(jaxrod.advance(scene, state, 2e-4, 200).tip ** 2)

    last, way, step = jnp.array([0.2, -0.1, 0.3]), jnp.array([1.0, -0.5, 0.7]), 1e-6
    slope = jax.jit(jax.grad(tip))(last) @ way
    run = jax.jit(tip)
    difference = (run(last + step * way) - run(last - step * way)) / (2 * step)
    np.testing.assert_allclose(slope, difference, rtol=1e-6)
    assert abs(slope) > 1e-3


@pytest.mark.slow
def test_a_slide_of_no_wall_drives_as_a_displacement(tmp_path):
    arm = crane(tmp_path, '<joint name="a" type="slide" axis="0 0 1"/>')
    rod, state = jaxrod.straight_rod(4, direction=(1.0, 0.0, 0.0), **ROD)
    up = schedules.ramp(jnp.zeros(1), jnp.array([0.1]), duration=0.1)
    far = schedules.ramp(jnp.zeros(3), jnp.array([0.0, 0.0, 0.1]), duration=0.1)
    pair = (
        arm.hold(state, up, 2, free_to_turn=True),
        jaxrod.driven(state, 2, displacement=far, free_to_turn=True),
    )
    ends = [
        jaxrod.advance(jaxrod.make_scene(rod, one), state, 2e-4, 500) for one in pair
    ]
    for a, b in zip(*map(jax.tree.leaves, ends), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-11)


@pytest.mark.slow
def test_an_arm_in_a_plane_holds_a_planar_rod_and_no_other_does(tmp_path):
    rod, state = jaxrod.straight_rod(
        4, direction=(1.0, 0.0, 0.0), normal=(0.0, 1.0, 0.0), **ROD
    )
    flat = crane(
        tmp_path,
        '<joint name="a" axis="0 1 0"/><joint name="b" axis="0 1 0" pos="0 0 1"/>',
    )
    swing = schedules.sine(jnp.array([0.4, -0.3]), 0.5)

    def step(arm, coordinates):
        held = arm.hold(state, coordinates, axes="zx")
        scene = jaxrod.make_scene(rod, held, method=jaxrod.planar("zx"))
        return jaxrod.step(scene, state, 1e-4)

    step(flat, swing)
    out = crane(
        tmp_path,
        '<joint name="a" axis="0 1 0"/><joint name="b" axis="1 0 0" pos="0 0 1"/>',
    )
    with pytest.raises(ValueError, match="plane"):
        step(out, swing)
    step(out, schedules.sine(jnp.array([0.4, 0.0]), 0.5))


@pytest.mark.parametrize(
    ("text", "hand", "words"),
    [
        (URDF, "thumb", "no link 'thumb', it has base, upper, lower, hand, lamp"),
        ("<mujoco><nothing/></mujoco>", "a", "as a robot"),
        (
            '<mujoco><worldbody><body name="a"><joint name="b" type="ball"/></body>'
            "</worldbody></mujoco>",
            "a",
            "'b' of .* must be a hinge or a slide",
        ),
        (
            '<mujoco><worldbody><body name="a"><joint name="b"/>'
            '<joint name="c" axis="1 0 0"/></body></worldbody>'
            '<equality><joint joint1="c" joint2="b"/></equality></mujoco>',
            "a",
            "'c' of .* follows another joint",
        ),
    ],
    ids=["link", "no robot", "ball", "follower"],
)
def test_bad_files_are_refused(tmp_path, text, hand, words):
    with pytest.raises(ValueError, match=words):
        jaxrod.robot_arm(written(tmp_path, text), hand)


def test_bad_arguments_are_refused(tmp_path):
    arm = crane(tmp_path, '<joint name="a"/>')
    _, state = jaxrod.straight_rod(4, **ROD)
    with pytest.raises(ValueError, match=r"coordinates.*\(1,\)"):
        arm.hold(state, (0.1, 0.2))
    with pytest.raises(ValueError, match="free_to_turn=True"):
        arm.hold(state, (0.1,), 2)
    with pytest.raises(ValueError, match="orientation must not be the zero"):
        jaxrod.robot_arm(tmp_path / "robot.xml", "hook", orientation=(0, 0, 0, 0))
    with pytest.raises(FileNotFoundError):
        jaxrod.robot_arm(tmp_path / "none.xml", "hook")


def test_without_mujoco_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(ImportError, match=r"jaxrod\[robot\]"):
        crane(tmp_path, "")
