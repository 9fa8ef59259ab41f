"""What the page draws is what the model and the renderers have."""

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("trimesh")  # comes with viser

from segvisrl_jax.config import ConfigError
from segvisrl_jax.env.rocks import goal_beacon
from segvisrl_jax.env.rover_env import make_env
from segvisrl_jax.view import solids
from segvisrl_jax.view.playback import Motion


@pytest.fixture(scope="module")
def env():
    return make_env(obs="state", num_rocks=3)


def test_the_rover_has_its_bodies_and_its_size(env):
    bodies = solids.rover_bodies(env.mj_model)
    assert len(bodies) == 5
    corners = {name: np.concatenate([part.vertices_m for part in parts]) for name, parts in bodies.items()}
    for name, points in corners.items():
        half = np.abs(points).max(axis=0)
        if name == "rover":
            assert 0.33 < points[:, 2].max() < 0.34  # the tip of the whip antenna
        else:
            assert half[[0, 2]] == pytest.approx([0.0698, 0.0698], abs=1e-3)  # tread on tyre
            assert half[1] < 0.03
    colours = [part.colour for part in bodies["front_left"]]
    assert len(set(colours)) == len(colours) >= 3


def test_every_primitive_lies_as_mujoco_says(env):
    """Bounding boxes of the parts against MuJoCo's own half sizes."""
    kinds = mujoco.mjtGeom
    size = np.array([0.1, 0.3, 0.05])
    expected = {
        kinds.mjGEOM_BOX: [0.1, 0.3, 0.05],
        kinds.mjGEOM_CYLINDER: [0.1, 0.1, 0.3],
        kinds.mjGEOM_CAPSULE: [0.1, 0.1, 0.4],
        kinds.mjGEOM_SPHERE: [0.1, 0.1, 0.1],
        kinds.mjGEOM_ELLIPSOID: [0.1, 0.3, 0.05],
    }
    for kind, half in expected.items():
        mesh = solids._primitive(kind, size)
        np.testing.assert_allclose(mesh.bounds, [np.negative(half), half], atol=2e-3)


WITH_A_MESH = """
<mujoco>
  <asset><mesh name="wedge" vertex="0 0 0  0.4 0 0  0 0.2 0  0 0 0.1"/></asset>
  <worldbody>
    <body name="rover"><freejoint/><geom type="mesh" mesh="wedge" pos="0.1 0 0.5" euler="0 0 90"/></body>
  </worldbody>
</mujoco>
"""


def test_a_mesh_lies_as_mujoco_says():
    model = mujoco.MjModel.from_xml_string(WITH_A_MESH)
    drawn = solids._geom(model, 0)
    np.testing.assert_allclose(drawn.bounds, [[-0.1, 0.0, 0.5], [0.1, 0.4, 0.6]], atol=1e-6)


def test_what_has_no_surface_is_refused_in_words():
    with pytest.raises(ConfigError, match=r"a geom of type mjGEOM_PLANE: should be a box, .* mesh"):
        solids._primitive(mujoco.mjtGeom.mjGEOM_PLANE, np.ones(3))


def test_bodies_stand_where_the_state_says(env):
    qpos = np.zeros(11)
    qpos[:4] = (3.0, -2.0, 0.07, np.cos(0.5))
    qpos[6] = np.sin(0.5)  # turned by 1 rad
    qpos[7] = 0.3  # the front left wheel
    poses = solids.body_poses(env.mj_model, mujoco.MjData(env.mj_model), qpos)
    np.testing.assert_allclose(poses["rover"][0], qpos[:3])
    turn = Rotation.from_euler("z", 1.0)
    np.testing.assert_allclose(poses["front_left"][0], qpos[:3] + turn.apply([0.09, 0.10, 0.0]), atol=1e-6)
    w, x, y, z = poses["front_left"][1]
    rolled = turn * Rotation.from_euler("y", 0.3)
    assert (Rotation.from_quat([x, y, z, w]).inv() * rolled).magnitude() < 1e-6


def test_rocks_and_beacon_are_the_renderers_polyhedra(env):
    solid = solids.library_solid(env.rocks, 2, (1, 2, 3))
    assert len(solid.faces) == env.rocks.num_faces[2]
    assert np.linalg.norm(solid.vertices_m[:, :2], axis=1).max() == pytest.approx(env.rocks.radius_m[2])
    assert solids.library_solid(goal_beacon(), 0, (1, 2, 3)).vertices_m[:, 2].max() == pytest.approx(1.4)


def test_a_motion_goes_through_its_poses_in_time():
    poses = np.zeros((3, 11))
    poses[:, 0] = (0.0, 1.0, 3.0)
    poses[0, 3], poses[1, 3:7], poses[2, 3] = 1.0, (0.0, 0.0, 0.0, -1.0), -1.0
    motion = Motion(poses, began_s=10.0, instant_s=0.5)
    assert motion.ends_s == 11.0
    assert [motion.at(t)[0] for t in (9.0, 10.0, 10.25, 10.5, 10.75, 11.0, 99.0)] == [0, 0, 0.5, 1, 2, 3, 3]
    halfway = motion.at(10.25)[3:7]
    np.testing.assert_allclose(halfway, np.array([1, 0, 0, -1]) / np.sqrt(2))
    assert np.linalg.norm(motion.at(10.6)[3:7]) == pytest.approx(1)
