"""Reconstruction from depth images: a rendered turntable whose truth is known, given poses, bad input, a real scan."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import small_gicp
from PIL import Image
from scipy.spatial import cKDTree
from typer.testing import CliRunner

import phytofit
import turntable_scene as scene
from phytofit.cli import app
from phytofit.errors import InputError, OutputError, SettingError
from phytofit.reconstruct.depth import read_poses
from phytofit.reconstruct.depth_files import depth_files, read_views
from phytofit.reconstruct.plant import bodies, find_support, seen_through
from phytofit.reconstruct.registration import Surface, exp_pose, log_pose, move_points, register
from phytofit.reconstruct.views import drop_flying_pixels, surface_normals

REAL = Path(__file__).parents[2] / "shared" / "data" / "mccormick2016_turntable"
N_VIEWS = 12


def write_images(folder, images):
    folder.mkdir(parents=True, exist_ok=True)
    for k, image in enumerate(images):
        Image.fromarray(image).save(folder / f"view_{k}.png")
    return folder


def write_camera(path, camera=scene.CAMERA, **changed):
    keys = ("fx", "fy", "cx", "cy", "width", "height")
    path.write_text("".join(f"{key} = {changed.get(key, getattr(camera, key))}\n" for key in keys))
    return path


@pytest.fixture(scope="module")
def scan():
    return scene.scan(scene.STEP_DEG * np.arange(N_VIEWS))


@pytest.fixture(scope="module")
def folder(scan, tmp_path_factory):
    return write_images(tmp_path_factory.mktemp("scan") / "images", scan.images)


@pytest.fixture(scope="module")
def camera_file(tmp_path_factory):
    return write_camera(tmp_path_factory.mktemp("camera") / "camera.toml")


@pytest.fixture(scope="module")
def result(folder, camera_file):
    return phytofit.reconstruct(folder, str(camera_file))


def turntable_pose(angle):
    """Camera to turntable, mm, for a camera that goes round a plant that stands still."""
    made = exp_pose(np.array([0, 0, -angle, 0, 0, 0])) @ np.linalg.inv(scene.camera_from_turntable())
    made[:3, 3] *= 10.0
    return made


@pytest.fixture(scope="module")
def posed(scan):
    poses = [turntable_pose(angle).tolist() for angle in scan.angles]
    return {"unit": "mm", "views": [{"file": f"view_{k}.png", "pose": pose} for k, pose in enumerate(poses)]}


@pytest.fixture(scope="module")
def truth():
    return scene.plant_points(150_000)


def true_axis():
    pose = scene.camera_from_turntable()
    return pose[:3, 2], pose[:3, 3]


class TestTurntable:
    def test_axis_and_step_are_found_from_nothing(self, result):
        up, point = true_axis()
        assert np.degrees(np.arccos(result.turn.up @ up)) < 0.2
        assert np.linalg.norm(np.cross(result.turn.point - point, up)) < 0.2  # cm: half a pixel on the plant
        assert result.step_deg == pytest.approx(scene.STEP_DEG, abs=0.3)
        assert np.degrees(result.turn.angles) == pytest.approx(scene.STEP_DEG * np.arange(N_VIEWS), abs=0.7)
        assert not result.rejected
        assert not result.flags

    def test_poses_are_those_of_the_render(self, result, scan):
        first = result.poses[0] @ scene.camera_from_turntable()  # turntable to world
        for pose, angle in zip(result.poses, scan.angles, strict=True):
            expected = (
                first @ exp_pose(np.array([0, 0, -angle, 0, 0, 0])) @ np.linalg.inv(scene.camera_from_turntable())
            )
            wrong_pose = np.linalg.inv(expected) @ pose
            wrong = log_pose(wrong_pose)
            assert np.degrees(np.linalg.norm(wrong[:3])) < 0.7
            assert (
                np.linalg.norm(
                    move_points(pose, scene.AXIS_POINT[None]) - move_points(expected, scene.AXIS_POINT[None])
                )
                < 0.4
            )

    def test_cloud_is_the_plant_without_its_pot(self, result, truth):
        placed = move_points(result.poses[0] @ scene.camera_from_turntable(), truth)
        away = cKDTree(placed).query(result.cloud.points)[0]
        assert np.median(away) < 0.1  # cm; the noise is 0.12, pixels are 0.42 apart
        assert np.quantile(away, 0.9) < 0.2
        assert away.max() < 1.5
        above = placed[placed[:, 2] > 2.0]
        missed = cKDTree(result.cloud.points).query(above)[0]
        assert np.quantile(missed, 0.9) < 0.5
        assert result.contradicted < 0.02

    def test_world_is_upright_with_the_rim_at_zero(self, result):
        turntable = result.poses[0] @ scene.camera_from_turntable()
        assert turntable[2, 2] > 0.9999
        assert turntable[2, 3] == pytest.approx(0.0, abs=1.5)  # the rim of the pot
        towards_camera = result.poses[0][:3, 3]
        assert towards_camera[0] > 50.0
        assert towards_camera[1] == pytest.approx(0.0, abs=1e-6)

    def test_points_count_their_views_and_keep_their_distance(self, result):
        assert len(result.n_views) == len(result.cloud)
        assert result.n_views.min() >= 1
        assert 3 <= np.median(result.n_views) <= N_VIEWS
        lengths = np.linalg.norm(result.cloud.normals, axis=1)
        assert lengths == pytest.approx(np.ones(len(lengths)))
        voxels = np.unique(np.floor(result.cloud.points / result.settings["spacing_cm"]), axis=0)
        assert len(voxels) > 0.9 * len(result.cloud)

    def test_loop_is_judged(self, result):
        rotation, shift = result.loop
        assert 0.0 < rotation < 15.0
        assert 0.0 < shift < 1.5
        assert result.residual_cm < 0.12

    def test_a_missing_a_repeated_an_empty_a_copied_and_a_foreign_view(self, scan, tmp_path):
        again = scene.scan([8 * scene.STEP_DEG + 0.4]).images
        foreign = scene.scan([100.0], points=scene.plant_points(200_000) * [1.1, -0.9, 0.8]).images
        images = [*scan.images[:4], *scan.images[5:9], *again, np.zeros_like(again[0]), *foreign, *scan.images[10:]]
        images.append(scan.images[10])  # 0 1 2 3 5 6 7 8 8' empty foreign 10 11 10
        found = phytofit.reconstruct(write_images(tmp_path, images), scene.CAMERA, step_deg=30.0)
        rejected = {view.file: view.reason for view in found.rejected}
        assert list(rejected) == ["view_9.png", "view_13.png", "view_10.png"]
        assert "empty" in rejected["view_9.png"]
        assert "duplicate of view_11.png" in rejected["view_13.png"]
        assert "does not fit the others" in rejected["view_10.png"]
        assert len(found.flags) == 2
        assert "view_4.png: turned 6" in found.flags[0]
        assert "missing" in found.flags[0]
        assert "view_8.png: turned 0." in found.flags[1]
        assert found.step_deg == pytest.approx(scene.STEP_DEG, abs=0.4)


class TestPoses:
    def test_known_viewpoints_need_no_turntable(self, posed, folder, truth, tmp_path):
        (tmp_path / "poses.json").write_text(json.dumps(posed))
        found = phytofit.reconstruct(folder, scene.CAMERA, poses=tmp_path / "poses.json")
        away = cKDTree(truth).query(found.cloud.points)[0]  # in the frame of the poses
        assert np.median(away) < 0.1
        assert np.quantile(away, 0.9) < 0.2
        assert found.turn is None
        assert found.cloud.points[:, 2].min() > -1.5

    @pytest.mark.parametrize(
        ("change", "said"),
        [
            (lambda p: p["views"].pop(), "no pose for view_11.png"),
            (lambda p: p.pop("unit"), "unit"),
            (lambda p: p["views"][3]["pose"][0].pop(), "not a file of poses"),
            (lambda p: p["views"][3]["pose"].pop(), "pose of view_3.png is not a rotation"),
            (lambda p: p["views"][3].update(pose=(2.0 * np.eye(4)).tolist()), "pose of view_3.png is not a rotation"),
        ],
    )
    def test_bad_poses(self, posed, change, said, tmp_path):
        wrong = json.loads(json.dumps(posed))
        change(wrong)
        path = tmp_path / "poses.json"
        path.write_text(json.dumps(wrong))
        with pytest.raises(InputError, match=said):
            read_poses(path, [f"view_{k}.png" for k in range(N_VIEWS)])

    def test_no_file_of_poses(self, tmp_path):
        with pytest.raises(InputError, match="can't be read"):
            read_poses(tmp_path / "none.json", ["a.png"])


class TestBadInput:
    def test_no_folder_and_an_empty_one(self, tmp_path):
        with pytest.raises(InputError, match="no such folder"):
            depth_files(tmp_path / "none")
        with pytest.raises(InputError, match="no depth images found"):
            depth_files(tmp_path)

    def test_files_come_in_the_order_of_their_numbers(self, tmp_path):
        for name in ("v_10.png", "v_9.png", "v_1.png", "notes.txt"):
            (tmp_path / name).touch()
        assert [path.name for path in depth_files(tmp_path)] == ["v_1.png", "v_9.png", "v_10.png"]

    @pytest.mark.parametrize(
        ("image", "said"),
        [
            (np.zeros((264, 320), np.uint8), "view_1.png: found an image of 8 bits"),
            (np.zeros((264, 320, 3), np.uint8), "view_1.png: found a colour image"),
            (
                np.full((100, 90), 900, np.uint16),
                "view_1.png: found 90 x 100 pixels, expected 320 x 264 of the camera test",
            ),
        ],
    )
    def test_an_image_unlike_the_others(self, image, said, scan, tmp_path):
        write_images(tmp_path, [scan.images[0], image, scan.images[2]])
        with pytest.raises(InputError, match=said):
            phytofit.reconstruct(tmp_path, scene.CAMERA)

    def test_another_cameras_size(self, folder):
        with pytest.raises(InputError, match=r"320 x 264 pixels, expected 512 x 424 of the camera kinect-v2"):
            phytofit.reconstruct(folder, "kinect-v2")

    def test_a_damaged_file(self, folder, tmp_path):
        (tmp_path / "view_0.png").write_bytes((folder / "view_0.png").read_bytes()[:500])
        with pytest.raises(InputError, match=r"view_0.png: can't be read"):
            read_views([tmp_path / "view_0.png"], scene.CAMERA)

    def test_a_wrong_unit(self, folder):
        with pytest.raises(
            InputError,
            match=r"median depth is .* cm if it is stored in steps of 1 m, expected",
        ):
            phytofit.reconstruct(folder, scene.CAMERA, unit="m")

    def test_npy_and_tiff_are_read_like_png(self, scan, tmp_path):
        write_images(tmp_path, scan.images[:1])
        Image.fromarray(scan.images[0]).save(tmp_path / "view_1.tif")
        np.save(tmp_path / "view_2.npy", scan.images[0].astype(np.float32))
        views, _ = read_views(depth_files(tmp_path), scene.CAMERA)
        assert len(views) == 3
        for view in views:
            assert view.depth == pytest.approx(0.1 * scan.images[0])

    def test_two_views_are_too_few(self, scan, tmp_path):
        with pytest.raises(InputError, match="found 2 usable views, expected at least 3"):
            phytofit.reconstruct(write_images(tmp_path, scan.images[:2]), scene.CAMERA)

    def test_no_plant_in_view(self, tmp_path):
        images = scene.scan(np.zeros(5), points=np.zeros((0, 3))).images
        with pytest.raises(InputError, match="no plant in view"):
            phytofit.reconstruct(write_images(tmp_path, images), scene.CAMERA)

    def test_wrong_intrinsics_are_refused(self, folder):
        wrong = replace(scene.CAMERA, fx=0.75 * scene.CAMERA.fx, fy=0.75 * scene.CAMERA.fy)
        with pytest.raises(InputError, match=r"views don't fit each other.*is the camera"):
            phytofit.reconstruct(folder, wrong, step_deg=31.0)

    def test_a_plant_that_fills_the_frame(self, scan, tmp_path):
        cut = slice(40, 170), slice(110, 200)
        camera = replace(scene.CAMERA, cx=159.5 - 110, cy=131.5 - 40, width=90, height=130)
        folder = write_images(tmp_path, [image[cut] for image in scan.images[:6]])
        found = phytofit.reconstruct(folder, camera, step_deg=31.0)
        assert any("cut by the image's edge in view_0.png" in flag for flag in found.flags)

    @pytest.mark.parametrize("step", [0.0, 200.0, np.nan])
    def test_impossible_steps(self, step, folder):
        with pytest.raises(SettingError, match="step_deg"):
            phytofit.reconstruct(folder, scene.CAMERA, step_deg=step)


class TestCamera:
    def test_presets(self):
        for name, camera in phytofit.CAMERAS.items():
            assert phytofit.load_camera(name) == camera

    def test_toml_with_scale_and_distortion(self, tmp_path):
        path = write_camera(tmp_path / "mine.toml")
        with path.open("a") as file:
            file.write('depth_scale = 0.25\nunit = "mm"\ndistortion = [0.1, -0.05, 0.001, -0.002, 0.01]\n')
        camera = phytofit.load_camera(str(path))
        assert camera.name == "mine"
        assert camera.step_cm == pytest.approx(0.025)
        rays = camera.rays()
        points = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=-1).reshape(-1, 3) * 80.0
        u, v = camera.project(points)
        rows, columns = np.mgrid[: camera.height, : camera.width]
        assert u == pytest.approx(columns.ravel(), abs=1e-6)
        assert v == pytest.approx(rows.ravel(), abs=1e-6)

    @pytest.mark.parametrize(
        ("text", "said"),
        [
            ("fx = 300.0\n", "fy is missing"),
            ("fx = 1\nfy = 1\ncx = 1\ncy = 1\nwidth = 9\nheight = 9\nfocal = 2\n", "focal is unknown"),
            ("fx = 0\nfy = 1\ncx = 1\ncy = 1\nwidth = 9\nheight = 9\n", "above 0"),
            ("fx = 1\nfy = 1\ncx = 10\ncy = 1\nwidth = 9\nheight = 9\n", "inside an image of 9 x 9"),
            ("fx = 'a'\nfy = 1\ncx = 1\ncy = 1\nwidth = 9\nheight = 9\n", "should be a valid number"),
            ("fx : 3", "not a TOML file"),
        ],
    )
    def test_bad_files(self, text, said, tmp_path):
        (tmp_path / "c.toml").write_text(text)
        with pytest.raises(InputError, match=said):
            phytofit.load_camera(str(tmp_path / "c.toml"))

    def test_unknown_names(self):
        with pytest.raises(InputError, match="expected kinect-v1"):
            phytofit.load_camera("kinect")


class TestParts:
    def test_registration_agrees_with_small_gicp(self):
        random = np.random.default_rng(5)
        xy = random.uniform(-20.0, 20.0, (4000, 2))
        points = np.column_stack([xy, 80.0 + 3.0 * np.sin(xy[:, 0] / 5.0) * np.cos(xy[:, 1] / 7.0)])
        pose = exp_pose(np.array([0.02, -0.01, 0.03, 0.3, -0.2, 0.4]))
        moved = move_points(np.linalg.inv(pose), points[::2] + 0.01 * random.standard_normal((2000, 3)))
        surfaces = [Surface(p, surface_normals(p)[0]) for p in (points[1::2], moved)]
        start = np.tile(np.eye(4), (2, 1, 1))

        def free(x):
            return np.stack([np.eye(4), exp_pose(x)])

        found = free(register(surfaces, start, [(0, 1)], free, 6))[1]
        peer = small_gicp.align(points[1::2], moved, downsampling_resolution=0.3, max_correspondence_distance=3.0)
        assert np.abs(log_pose(np.linalg.inv(pose) @ found)[:3]).max() < 1e-3
        at = np.array([[0.0, 0.0, 80.0]])
        assert move_points(found, at) == pytest.approx(move_points(pose, at), abs=0.03)
        assert move_points(found, at) == pytest.approx(move_points(peer.T_target_source, at), abs=0.05)

    def test_pixels_between_two_surfaces_go_and_slanted_planes_stay(self):
        depth = np.full((40, 60), 100.0)
        depth[:, 30:] = 150.0
        depth[:, 29] = 125.0
        kept = drop_flying_pixels(depth, scene.CAMERA)
        assert (kept[5:35, 29] > 0).all()  # a column links up and down: a thin leaf looks just so
        depth[::2, 29] = 110.0
        kept = drop_flying_pixels(depth, scene.CAMERA)
        assert (kept[2:-2, 29] == 0).all()
        assert (kept[1:-1, :28] > 0).all()
        slanted = 100.0 + np.tan(np.radians(75.0)) * (np.arange(60.0) * 100.0 / 228.0)[None, :].repeat(40, axis=0)
        assert (drop_flying_pixels(slanted, scene.CAMERA)[1:-1] > 0).all()

    def test_normals_of_a_plane_face_the_camera(self):
        random = np.random.default_rng(1)
        xy = random.uniform(-10.0, 10.0, (2000, 2))
        points = np.column_stack([xy, 90.0 + 0.5 * xy[:, 0]])
        normals, flat = surface_normals(points)
        assert normals @ (np.array([0.5, 0.0, -1.0]) / np.hypot(0.5, 1.0)) == pytest.approx(np.ones(2000), abs=1e-9)
        assert np.median(flat) > 0.3
        assert surface_normals(points[:1])[1] == pytest.approx([0.0])

    @pytest.mark.parametrize("facing", [None, 0.0])
    def test_a_pot_is_found_and_a_stem_is_not(self, facing):
        pot = scene.pot_points(density=20.0)
        stem = np.column_stack([1 + 0.9 * np.cos(np.arange(3000.0)), 0.9 * np.sin(np.arange(3000.0)),
                                np.linspace(0, 40, 3000)])  # fmt: skip
        found = find_support(np.concatenate([pot, stem]), facing=facing)
        assert found.top == pytest.approx(0.0, abs=1.0)
        assert found.covers(pot).all()
        assert not found.covers(stem[stem[:, 2] > 2.0]).any()
        assert find_support(stem, facing=facing) is None
        assert find_support(np.zeros((0, 3)), facing=facing) is None

    def test_square_pots_count_as_round(self):
        random = np.random.default_rng(2)
        side = random.uniform(-6.0, 6.0, 6000)
        wall = np.concatenate([np.column_stack([side, np.full(6000, s * 6.0)]) for s in (-1, 1)])
        wall = np.concatenate([wall, wall[:, ::-1]])
        pot = np.column_stack([wall, random.uniform(0.0, 10.0, len(wall))])
        assert find_support(pot).top == pytest.approx(10.0, abs=1.0)

    def test_bodies_are_ordered_by_size(self):
        random = np.random.default_rng(3)
        small, large = random.uniform(0, 2, (50, 3)), random.uniform(0, 2, (90, 3)) + 500.0
        found = bodies(np.concatenate([small, large, [[9e3, 0, 0]]]), cell_cm=1.0)
        assert found.tolist() == [1] * 50 + [0] * 90 + [2]
        assert len(bodies(np.zeros((0, 3)), cell_cm=1.0)) == 0

    def test_a_point_in_the_air_is_seen_through(self):
        camera = replace(scene.CAMERA, cx=160.0, cy=132.0)
        depth = np.full((264, 320), 100.0)
        through, seen = seen_through(
            np.array([[0.0, 0.0, 60.0], [0.0, 0.0, 100.0], [0.0, 0.0, 120.0], [0.0, 0.0, -5.0]]),
            np.eye(4)[None],
            [depth],
            camera,
        )
        assert through.tolist() == [1, 0, 0, 0]
        assert seen.tolist() == [0, 1, 0, 0]


@pytest.fixture(scope="module")
def ran(folder, camera_file, tmp_path_factory):
    out = tmp_path_factory.mktemp("cli") / "out"
    done = CliRunner().invoke(app, ["reconstruct", str(folder), "--camera", str(camera_file), "--out", str(out)])
    return done, out


class TestCommandLine:
    def test_results_are_written_and_read_back(self, ran):
        done, out = ran
        assert done.exit_code == 0, done.output
        names = ["phytofit.log", "plant.ply", "reconstruction.json", "reconstruction.png"]
        assert sorted(p.name for p in out.iterdir()) == names
        stored = json.loads((out / "reconstruction.json").read_text())
        assert stored["turntable"]["step_deg"] == pytest.approx(scene.STEP_DEG, abs=0.4)
        assert len(stored["views"]) == N_VIEWS
        cloud = phytofit.read_cloud(out / "plant.ply", "cm")
        assert len(cloud) == stored["n_points"] == sum(stored["points_seen_by"].values())
        poses = read_poses(out / "reconstruction.json", [f"view_{k}.png" for k in range(N_VIEWS)])
        assert poses["view_3.png"] == pytest.approx(np.array(stored["views"][3]["pose"]))

    def test_the_same_images_give_the_same_bytes(self, ran, result, tmp_path):
        phytofit.save_reconstruction(result, tmp_path)
        for name in ("plant.ply", "reconstruction.json", "reconstruction.png"):
            assert (ran[1] / name).read_bytes() == (tmp_path / name).read_bytes()

    def test_bad_input_is_one_line_and_nothing_is_written(self, folder, tmp_path):
        arguments = ["reconstruct", str(folder), "--camera", "kinect-v2", "--out", str(tmp_path / "out")]
        done = CliRunner().invoke(app, arguments)
        assert done.exit_code == 2
        assert "expected 512 x 424" in done.output
        assert len(done.output.strip().splitlines()) == 1
        assert [path.name for path in (tmp_path / "out").iterdir()] == ["phytofit.log"]

    def test_a_folder_that_can_not_be_written(self, result, tmp_path):
        (tmp_path / "file").touch()
        with pytest.raises(OutputError, match="results can't be written"):
            phytofit.save_reconstruction(result, tmp_path / "file")


@pytest.mark.skipif(not REAL.exists(), reason=f"no real scan in {REAL}")
@pytest.mark.long
def test_a_real_scan_is_fused_within_its_noise():
    found = phytofit.reconstruct(REAL, "kinect-v2", pattern="DepthImage_*.png", step_deg=30.0)
    assert abs(found.step_deg) == pytest.approx(360.0 / 11.0, abs=0.3)
    assert found.turn.up == pytest.approx(-np.array([0.023, 0.927, 0.375]), abs=0.01)
    off = np.cross(found.turn.point - [-8.07, 0.0, 93.35], found.turn.up)
    assert np.linalg.norm(off) < 0.5
    assert not found.rejected
    assert found.residual_cm < 0.25
    assert np.ptp(found.cloud.points[:, 2]) == pytest.approx(61.0, abs=2.0)  # the mesh's height
