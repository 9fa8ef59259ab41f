"""The model: names, settings, meshes that stand where the library says, a camera without rover."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from segvisrl_jax.config import CameraConfig, EnvConfig, PhysicsConfig, SceneConfig
from segvisrl_jax.env import model as rover_model
from segvisrl_jax.env.pose import camera_mount, camera_pose, up_z, yaw_rad
from segvisrl_jax.env.rocks import goal_beacon, rock_library
from segvisrl_jax.env.scene import sample_scene
from segvisrl_jax.types import ConvexSolids, PhysicsState, Scene

CONFIG = EnvConfig()
LARGEST_REACH_M = 0.20  # with rocks of up to 0.30 m the 0.5 m collision rule comes before any touch


@pytest.fixture(scope="module")
def full() -> mujoco.MjModel:
    return rover_model.build_model(CONFIG)


@pytest.fixture(scope="module")
def lean() -> mujoco.MjModel:
    return rover_model.build_physics_model(CONFIG)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return sample_scene(jax.random.key(3), CONFIG.scene, rock_library(CONFIG.scene))


def random_physics(seed: int) -> PhysicsState:
    rng = np.random.default_rng(seed)
    qpos = rng.normal(size=11)
    qpos[3:7] /= np.linalg.norm(qpos[3:7])
    return PhysicsState(
        qpos=jnp.asarray(qpos, jnp.float32),
        qvel=jnp.asarray(rng.normal(size=10), jnp.float32),
    )


def names(model: mujoco.MjModel, kind: str, count: int) -> list[str]:
    return [getattr(model, kind)(index).name for index in range(count)]


def test_sizes_and_order_of_coordinates(full: mujoco.MjModel, lean: mujoco.MjModel) -> None:
    for model in (full, lean):
        assert (model.nq, model.nv, model.nu) == (11, 10, 4)
        joints = ["rover", *rover_model.WHEEL_NAMES]
        assert names(model, "joint", model.njnt) == joints
        assert names(model, "actuator", model.nu) == list(rover_model.WHEEL_NAMES)
        assert model.actuator_trnid[:, 0].tolist() == [1, 2, 3, 4]


def test_geom_names_tell_the_class(full: mujoco.MjModel) -> None:
    geoms = names(full, "geom", full.ngeom)
    assert all(name.startswith(("rover", "ground", "rock", "goal")) for name in geoms)
    rocks = [name for name in geoms if name.startswith("rock")]
    assert rocks == [f"rock{index}" for index in range(CONFIG.scene.num_rock_shapes)]
    assert geoms.count("ground") == geoms.count("goal") == 1


def test_lean_model_moves_as_the_full_one(full: mujoco.MjModel, lean: mujoco.MjModel) -> None:
    assert lean.ngeom == 5
    for name in ("rover", *rover_model.WHEEL_NAMES):
        for field in ("mass", "inertia", "ipos", "iquat", "pos", "quat"):
            np.testing.assert_array_equal(getattr(full.body(name), field), getattr(lean.body(name), field))
    finals = []
    for model in (full, lean):
        data = mujoco.MjData(model)
        data.ctrl[:] = (0.5, 2.0, 0.5, 2.0)
        mujoco.mj_step(model, data, nstep=100)
        finals.append(np.concatenate([data.qpos, data.qvel]))
    np.testing.assert_allclose(finals[0], finals[1], atol=1e-12)
    assert np.linalg.norm(finals[0][:2]) > 0.01  # it did drive


def test_only_wheels_touch_only_the_ground(full: mujoco.MjModel) -> None:
    assert full.npair == 4
    assert not full.geom_contype.any()
    assert not full.geom_conaffinity.any()


def test_settings_reach_the_model() -> None:
    config = EnvConfig(
        scene=SceneConfig(map_size_m=40.0, num_rocks=1, num_rock_shapes=2, sun_azimuth_deg=0.0),
        physics=PhysicsConfig(timestep_s=0.01, gravity_m_s2=3.24, wheel_friction=0.5, top_speed_m_s=0.35),
        camera=CameraConfig(width_px=640, height_px=480, near_m=0.02, far_m=30.0),
    )
    model = rover_model.build_model(config)
    assert model.opt.timestep == 0.01
    np.testing.assert_allclose(model.opt.gravity, (0, 0, -3.24))
    np.testing.assert_allclose(model.pair_friction[:, :2], 0.5)
    np.testing.assert_allclose(model.actuator_ctrlrange, [[0, 5.0]] * 4)
    np.testing.assert_allclose(model.actuator_forcerange, [[-0.24, 0.24]] * 4)
    np.testing.assert_allclose(model.geom("ground").size[:2], 20.0)
    np.testing.assert_allclose(model.camera("d435").fovy, config.camera.vertical_fov_deg)
    assert model.stat.extent == 1.0
    assert (model.vis.map.znear, model.vis.map.zfar) == pytest.approx((0.02, 30.0))
    assert (model.vis.global_.offwidth, model.vis.global_.offheight) == (640, 480)
    assert model.vis.quality.offsamples == 0
    direction = model.light("sun").dir
    np.testing.assert_allclose(direction, (-np.cos(np.pi / 6), 0, -0.5), atol=1e-6)
    assert model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_AUTORESET


def test_without_rocks() -> None:
    config = EnvConfig(scene=SceneConfig(num_rocks=0, num_rock_shapes=1))
    model = rover_model.build_model(config)
    scene = sample_scene(jax.random.key(0), config.scene, rock_library(config.scene))
    rover_model.set_mujoco_state(model, mujoco.MjData(model), random_physics(0), scene)


def drawn_corners(model: mujoco.MjModel, data: mujoco.MjData, name: str) -> np.ndarray:
    """World positions [F, 3, 3] of the corners of a mesh geom's faces, as a renderer gets them."""
    geom = model.geom(name).id
    mesh = model.geom_dataid[geom]
    first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    vertices = model.mesh_vert[first : first + count]
    first, count = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    corners = vertices[model.mesh_face[first : first + count]]
    return corners @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]


def placed_corners(solids: ConvexSolids, index: int, xy: np.ndarray, yaw: float) -> np.ndarray:
    """The same from the library."""
    corners = solids.vertices_m[index][solids.faces[index, : solids.num_faces[index]]]
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    return corners @ turn.T + np.array([*xy, 0.0])


def test_solids_stand_where_the_scene_says(full: mujoco.MjModel, scene: Scene) -> None:
    data = mujoco.MjData(full)
    rover_model.set_mujoco_state(full, data, random_physics(0), scene)
    library = rock_library(CONFIG.scene)
    for k, shape in enumerate(np.asarray(scene.rock_shape)):
        expected = placed_corners(library, shape, scene.rock_xy_m[k], float(scene.rock_yaw_rad[k]))
        np.testing.assert_allclose(drawn_corners(full, data, f"rock{shape}"), expected, atol=1e-5)
    expected = placed_corners(goal_beacon(), 0, scene.goal_xy_m, float(scene.goal_yaw_rad))
    np.testing.assert_allclose(drawn_corners(full, data, "goal"), expected, atol=1e-5)


def test_faces_are_drawn_flat(full: mujoco.MjModel) -> None:
    for mesh in range(full.nmesh):
        first, count = full.mesh_vertadr[mesh], full.mesh_vertnum[mesh]
        vertices = full.mesh_vert[first : first + count]
        faces = slice(full.mesh_faceadr[mesh], full.mesh_faceadr[mesh] + full.mesh_facenum[mesh])
        a, b, c = np.moveaxis(vertices[full.mesh_face[faces]], 1, 0)
        normal = np.cross(b - a, c - a)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        drawn = full.mesh_normal[full.mesh_normaladr[mesh] :][full.mesh_facenormal[faces]]
        np.testing.assert_allclose(drawn, np.repeat(normal[:, None], 3, axis=1), atol=1e-3)
        outwards = np.einsum("ij,ij->i", normal, (a + b + c) / 3)  # the mesh's middle is the origin
        assert (outwards > 0).all()


def test_state_of_the_data(full: mujoco.MjModel, scene: Scene) -> None:
    data = mujoco.MjData(full)
    first = dataclasses.replace(scene, rock_shape=scene.rock_shape[::-1])
    rover_model.set_mujoco_state(full, data, random_physics(1), first)
    physics = random_physics(2)
    sun = jnp.asarray([0.0, 0.6, 0.8], jnp.float32)
    second = dataclasses.replace(scene, rock_shape=jnp.arange(10, 14), sun_direction=sun)
    rover_model.set_mujoco_state(full, data, physics, second)
    np.testing.assert_array_equal(data.qpos.astype(np.float32), physics.qpos)
    np.testing.assert_array_equal(data.qvel.astype(np.float32), physics.qvel)
    for index in range(CONFIG.scene.num_rock_shapes):
        height = data.body(f"rock{index}").xpos[2]
        assert height == (0.0 if 10 <= index < 14 else rover_model.PARKED_Z_M)
    np.testing.assert_allclose(data.light("sun").xdir, -sun, atol=1e-7)


def test_camera_pose_is_mujocos(full: mujoco.MjModel, scene: Scene) -> None:
    data, mount = mujoco.MjData(full), camera_mount(full)
    for seed in range(20):
        physics = random_physics(seed)
        rover_model.set_mujoco_state(full, data, physics, scene)
        pose = camera_pose(physics, mount)
        camera = data.camera("d435")
        np.testing.assert_allclose(pose.position_m, camera.xpos, atol=2e-6)
        np.testing.assert_allclose(pose.rotation, camera.xmat.reshape(3, 3), atol=2e-6)
        axes = data.body("rover").xmat.reshape(3, 3)
        heading = float(yaw_rad(physics.qpos))
        assert heading == pytest.approx(np.arctan2(axes[1, 0], axes[0, 0]), abs=1e-5)
        assert float(up_z(physics.qpos)) == pytest.approx(axes[2, 2], abs=1e-6)


def test_camera_is_level_and_looks_ahead(full: mujoco.MjModel) -> None:
    mount = camera_mount(full)
    np.testing.assert_allclose(mount.rotation, [[0, 0, -1], [-1, 0, 0], [0, 1, 0]], atol=1e-7)
    height = mount.position_m[2] + full.body("rover").pos[2]
    assert 0.2 < height < 0.3


def test_rover_is_within_the_collision_rule(full: mujoco.MjModel) -> None:
    data = mujoco.MjData(full)
    mujoco.mj_forward(full, data)
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, 8).T
    seen = [g for g in range(full.ngeom) if full.geom(g).name.startswith("rover")]
    reach = []
    for geom in (g for g in seen if not full.geom(g).name.endswith("contact")):
        box = full.geom_aabb[geom, :3] + signs * full.geom_aabb[geom, 3:]
        corners = box @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
        reach.append(np.linalg.norm(corners[:, :2], axis=1).max())
    assert 0.15 < max(reach) <= LARGEST_REACH_M


@pytest.mark.gl
def test_camera_sees_nothing_of_the_rover(full: mujoco.MjModel, scene: Scene) -> None:
    data = mujoco.MjData(full)
    tilts = [(0, 0), (0, 0.05), (0, -0.05), (0.05, 0), (-0.1, 0.1)]  # roll, pitch in rad
    with mujoco.Renderer(full, 540, 960) as renderer:
        renderer.enable_segmentation_rendering()
        for wheel_angle, (roll, pitch) in enumerate(tilts):
            qpos = np.r_[CONFIG.scene.start_xy_m, 0.07, 1, roll / 2, pitch / 2, 0, [wheel_angle] * 4]
            state = PhysicsState(qpos=qpos, qvel=np.zeros(10))
            rover_model.set_mujoco_state(full, data, state, scene)
            renderer.update_scene(data, "d435")
            ids = np.unique(renderer.render()[..., 0])
            seen = {full.geom(geom).name for geom in ids if geom >= 0}
            assert "ground" in seen
            assert not any(name.startswith("rover") for name in seen)
