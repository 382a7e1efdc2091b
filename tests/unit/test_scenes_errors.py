"""Errors of scene files: one line that names the file, the key and the valid values."""

import re

import pytest

import fidsplat as fs

GOOD = """[camera]
width = 64
height = 48
fov_x_deg = 60.0
position = [0.0, 0.0, -1.0]
look_at = [0.0, 0.0, 0.0]
near = 0.1

[[splats]]
file = "empty.ply"
scale = 1.0
quaternion = [1.0, 0.0, 0.0, 0.0]

[render]
outputs = ["rgb"]
background = [0.0, 0.0, 0.0]
quality = "fast"
samples = 1
device = "reference"
"""
MARKER = '[[markers]]\nspec = "apriltag:36h11:5"\nsize = 0.1\nposition = [1.0, 2.0, 3.0]\n'


@pytest.fixture
def refused(tmp_path):
    fs.save_ply(fs.SplatCloud.empty(), tmp_path / "empty.ply")
    path = tmp_path / "scene.toml"

    def check(content, words):
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        with pytest.raises(fs.InputError, match=words) as caught:
            fs.Scene.load(path)
        assert str(path) in str(caught.value)
        assert "\n" not in str(caught.value)

    path.write_text(GOOD)
    assert fs.Scene.load(path).camera is not None
    return check


CHANGES = [
    ("width", "widht", "unknown key 'camera.widht' (did you mean 'width'?)"),
    ("fov_x_deg", "fov_deg", "'camera.fov_deg' (did you mean 'fov_x_deg'?)"),
    ("look_at", "lookat", "'camera.lookat' (did you mean 'look_at'?)"),
    ("near", "Near", "'camera.Near' (did you mean 'near'?)"),
    ("file", "fiel", "unknown key 'splats[0].fiel' (did you mean 'file'?)"),
    ("outputs", "output", "unknown key 'render.output' (did you mean 'outputs'?)"),
    ("background", "colour", "unknown key 'render.colour' (did you mean"),
    ("[render]", "[rendering]", "unknown table 'rendering' (did you mean 'render'?)"),
    ("[[splats]]", "[[splat]]", "unknown key 'splat' (did you mean 'splats'?)"),
    ("[camera]", "[camera.distorsion]\nk1 = 0.1\n[camera]", "unknown table 'camera.distorsion' (did"),
    ("width = 64\n", "", "camera.width is missing"),
    ("width = 64\n", f"width = {2**63}\n", "camera.width must be a whole number of at most 64 bits"),
    ("fov_x_deg = 60.0\n", "", "camera.fov_x_deg is missing (or fx and fy)"),
    ("fov_x_deg = 60.0\n", "fx = 60.0\n", "camera.fy is missing"),
    (
        "position = [0.0, 0.0, -1.0]\n",
        "",
        "camera.position is missing (position and look_at, or world_to_camera)",
    ),
    ("look_at = [0.0, 0.0, 0.0]\n", "", "camera.look_at is missing"),
    ('file = "empty.ply"\n', "", "splats[0].file is missing"),
    ("64", "64.0", "camera.width must be a whole number"),
    ("64", "true", "camera.width must be a whole number"),
    ("64", "0", "camera: camera width must be 1 to 32767 pixels, got 0"),
    ("64", "-1", "camera width must be 1 to 32767"),
    ("48", "40000", "camera height must be 1 to 32767"),
    ("48", "1" + "0" * 400, "camera.height must be a whole number of at most 64 bits"),
    ("48", "1" + "0" * 5000, "is not a scene file in TOML"),
    ("60.0", "180.0", "camera.fov_x_deg: camera fov_x must be between 0 and pi radians (180 degrees)"),
    ("60.0", "0", "camera.fov_x_deg: camera fov_x must be between"),
    ("60.0", '"wide"', "camera.fov_x_deg must be a number, got 'wide'"),
    ("60.0", "nan", "camera.fov_x_deg must be a finite number"),
    ("60.0", "60.0\nfx = 50.0", "camera.fx and fov_x_deg exclude each other"),
    ("near", "world_to_camera = []\nnear", "camera.position and world_to_camera exclude each other"),
    ("[0.0, 0.0, -1.0]", "[0.0, -1.0]", "camera.position must be a list of 3 numbers, got a list of 2"),
    ("[0.0, 0.0, -1.0]", "0.0", "camera.position must be a list of 3 numbers, got 0.0"),
    ("[0.0, 0.0, -1.0]", '[0.0, "a", 1]', "camera.position[1] must be a number, got 'a'"),
    ("[0.0, 0.0, -1.0]", "[0.0, 0.0, inf]", "camera.position[2] must be a finite number"),
    ("[0.0, 0.0, -1.0]", "[0.0, 0.0, 1" + "0" * 400 + "]", "camera.position[2] must be a finite number"),
    (
        "[0.0, 0.0, -1.0]",
        "[0.0, 0.0, 0.0]",
        "camera.look_at: camera position and look_at must be diff",
    ),
    (
        "near = 0.1",
        "up = [0.0, 0.0, 1.0]",
        "must not be parallel to the optical axis, got (0.0, 0.0, 1.0); give another direction",
    ),
    ("near = 0.1", "near = 0.0", "camera near must be above 0"),
    ("near = 0.1", "far = 0.001", "camera far must be above near"),
    ("near = 0.1", "far = nan", "camera.far must be a finite number"),
    ("empty.ply", "absent.ply", "splats[0].file: cannot read"),
    ("empty.ply", "scene.toml", "unknown suffix of a splat file '.toml'"),
    ('"empty.ply"', "7", "splats[0].file must be text, got 7"),
    ('"empty.ply"', '""', "splats[0].file must be text"),
    ("scale = 1.0", "scale = 0.0", "splats[0].scale must be above 0"),
    ("[1.0, 0.0, 0.0, 0.0]", "[0, 0, 0, 0]", "splats[0].quaternion: quaternion must be four"),
    ("[[splats]]", "[splats]", "splats must be written [[splats]]"),
    ('["rgb"]', '"rgb"', "render.outputs must be a list of one or more texts"),
    ('["rgb"]', "[]", "render.outputs must be a list of one or more texts"),
    ('["rgb"]', "[1]", "render.outputs must be a list of one or more texts"),
    ("background = [0.0, 0.0, 0.0]", "background = [0.0]", "render.background must be a list of 3 numbers"),
    ('"fast"', '"fats"', "render.quality: unknown quality 'fats' (did you mean 'fast'?)"),
    ("samples = 1", "samples = 99", "render.quality: samples must be"),
    ("samples = 1", "samples = 1.5", "render.samples must be a whole number"),
    ('"reference"', "1", "render.device must be text"),
    ("[render]", "[[render]]", "render must be a table, got a list of 1"),
    ("width = 64", "width =", "is not a scene file in TOML"),
]


@pytest.mark.parametrize(("old", "new", "words"), CHANGES)
def test_one_error(refused, old, new, words):
    assert old in GOOD
    refused(GOOD.replace(old, new, 1), re.escape(words))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("size", "siez", "unknown key 'markers[0].siez' (did you mean 'size'?)"),
        ("size = 0.1\n", "", "markers[0].size is missing"),
        ("0.1", '"big"', "markers[0].size must be a number, got 'big'"),
        ("0.1", "0", "markers[0].size must be above 0 metres"),
        ("0.1", "-0.1", "markers[0].size must be above 0 metres"),
        ("0.1", "0.1\nquiet_zone = -1", "markers[0].quiet_zone must be 0 or more"),
        ("0.1", "0.1\nquiet_zone = 1.5", "markers[0].quiet_zone must be a whole number"),
        ("0.1", "0.1\nmixture = 3", "markers[0].mixture must be text"),
        ("0.1", "0.1\nquaternion = [1.0]", "markers[0].quaternion must be a list of 4 numbers"),
        ("0.1", "0.1\nquaternion = [0, 0, 0, 0]", "markers[0].quaternion: quaternion must be four"),
        ("[1.0, 2.0, 3.0]", "[1.0, 2.0]", "markers[0].position must be a list of 3 numbers"),
        ('spec = "apriltag:36h11:5"\n', "", "markers[0].spec is missing"),
    ],
)
def test_an_error_of_a_marker(refused, old, new, words):
    assert old in MARKER
    refused(GOOD + MARKER.replace(old, new, 1), re.escape(words))


def test_the_second_of_two_is_named(refused):
    refused(GOOD + 2 * '[[splats]]\nfile = "empty.ply"\n' + '[[splats]]\nfile = ""\n', r"splats\[3\]\.file")


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ("[1, 2, 3, 4]", r"world_to_camera\[0\] must be a list of 4 numbers, got 1"),
        (
            "[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]",
            "must be a list of 4 rows of 4 numbers, got a list of 3",
        ),
        (
            "[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1], [0, 0, 0, 1]]",
            r"world_to_camera\[2\] must be a list of 4",
        ),
        (
            "[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]",
            "world_to_camera must be a rotation .* by 1 where 1e-06 is allowed$",
        ),
        (
            "[[0.9553, -0.2955, 0, 0], [0.2955, 0.9553, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]",
            "by 5e-05 where 1e-06 is allowed; give more digits",
        ),
        ("[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 1, 1]]", "must have the last row"),
        ("{}", "must be a list of 4 rows of 4 numbers, got a table"),
    ],
)
def test_an_invalid_matrix(refused, rows, words):
    pose = f"world_to_camera = {rows}\n"
    refused(f"[camera]\nwidth = 4\nheight = 4\nfov_x_deg = 60\n{pose}", words)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"\x89PNG\r\n\x1a\n\xff\xfe", "not text in UTF-8"),
        (b"a = " + b"[" * 100000, "is not a scene file"),
        (b"#" * (2**24 + 1), "at most 16,777,216 bytes"),
        (b"camera" + b".a" * 100_000 + b" = 1", "a dotted key has more than 8 parts"),
        (b"[" + b"a . " * 1_000_000 + b"a]", "a dotted key has more than 8 parts"),
        (b"a = {b = {" + b"'x'.\"y\"." * 4 + b"z = 1}}", "a dotted key has more than 8 parts"),
        (b"a = {b" * 100_000, "is not a scene file"),
        (b"a" * 10**6 + b" = 1", "unknown key 'a{800,} ... a+.*; known: camera, splats"),
        (b"camera = 3", "camera must be a table, got 3"),
        (b"splats = [3]", r"splats\[0\] must be a table, got 3"),
        (b"splats = 'a'", r"splats must be written \[\[splats\]\]"),
    ],
)
def test_files_that_are_not_scene_files(refused, content, words):
    refused(content, words)


def test_a_byte_order_mark_is_skipped(tmp_path):
    """Windows editors add a byte-order mark to UTF-8."""
    path = tmp_path / "scene.toml"
    path.write_text("[render]\nbackground = [0.5, 0.25, 0.0]\n", "utf-8-sig")
    assert fs.Scene.load(path).background == (0.5, 0.25, 0.0)


def test_dots_outside_of_keys_are_accepted(tmp_path):
    path = tmp_path / "scene.toml"
    dots = "a." * 1000
    path.write_text(
        f'[[markers]] # {dots}\nspec = "qr:\\"{dots}"\nsize = 0.1\nposition = [{"1.5, " * 3}]\n'
        f"[render]\ndevice = \"\"\"\n\"\" {dots}\"\"\"\noutputs = ['{dots}', '''{dots}b''']\n"
    )
    scene = fs.Scene.load(path)
    assert scene.device == f'"" {dots}'
    assert scene.outputs == (dots, f"{dots}b")
    assert scene.markers[0].marker.payload == f'"{dots}'


@pytest.mark.parametrize("path", [5, None, b"a.toml", "\ud800", [], "a\0b", "a" * 256, "a/" * 2048 + "b"])
def test_invalid_paths(path):
    from fidsplat.images.files import read_image

    cloud = fs.SplatCloud.empty()
    for use in (
        fs.Scene.load,
        fs.Scene().save,
        fs.load_ply,
        lambda name: fs.save_ply(cloud, name),
        read_image,
    ):
        with pytest.raises(fs.InputError, match=r"a path must be text|a file name must have"):
            use(path)


def test_missing_and_unreadable_files(tmp_path):
    with pytest.raises(fs.InputError, match=r"cannot read .*none\.toml: No such file"):
        fs.Scene.load(tmp_path / "none.toml")
    with pytest.raises(fs.InputError, match="must be a regular file, got a folder"):
        fs.Scene.load(tmp_path)
    with pytest.raises(fs.InputError, match="a path must be text"):
        fs.Scene.load("a\0b")
