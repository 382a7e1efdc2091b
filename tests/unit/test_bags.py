"""rosbag2 folders: compressed ones and compression bombs, names of folders, metadata and databases."""

import sqlite3
import time

import numpy as np
import pytest

import fidsplat as fs

rosbag2 = pytest.importorskip("rosbags.rosbag2", reason="pip install 'fidsplat[logs]'")
highlevel = pytest.importorskip("rosbags.highlevel", reason="pip install 'fidsplat[logs]'")
writer = pytest.importorskip("mcap.writer", reason="pip install 'fidsplat[logs]'")
lz4 = pytest.importorskip("lz4.frame", reason="pip install 'fidsplat[logs]'")

PIXELS = np.arange(2 * 4 * 3, dtype=np.uint8)
BLACK = np.zeros(2**22, np.uint8)
"""compresses to less than 1 KiB"""


def foreign_bag(path, mode="NONE", storage="SQLITE3", pixels=PIXELS):
    """A bag of two images 4 pixels wide, by the writer of rosbags."""
    from fidsplat.logs.writers import typestore

    store = typestore()
    kinds = store.types
    header = kinds["std_msgs/msg/Header"](kinds["builtin_interfaces/msg/Time"](1, 0), "camera")
    image = kinds["sensor_msgs/msg/Image"](header, len(pixels) // 12, 4, "rgb8", 0, 12, pixels)
    bag = rosbag2.Writer(path, version=9, storage_plugin=rosbag2.StoragePlugin[storage])
    bag.set_compression(rosbag2.CompressionMode[mode], rosbag2.CompressionFormat.ZSTD)
    with bag:
        topic = bag.add_connection("/a", "sensor_msgs/msg/Image", typestore=store)
        for k in range(2):
            bag.write(topic, k, store.serialize_cdr(image, "sensor_msgs/msg/Image"))
    return path


def images(path):
    from fidsplat.logs import log_images

    return [one.image for one in log_images(path)]


@pytest.fixture
def small_limit(monkeypatch):
    monkeypatch.setattr("fidsplat.util.limits.FLOOR", 2**21)
    monkeypatch.setattr("fidsplat.util.limits.RATIO", 1)


KINDS = [
    ("NONE", "SQLITE3"),
    ("FILE", "SQLITE3"),
    ("MESSAGE", "SQLITE3"),
    ("NONE", "MCAP"),
    ("FILE", "MCAP"),
    ("MESSAGE", "MCAP"),
    ("STORAGE", "MCAP"),
]


@pytest.mark.parametrize(("mode", "storage"), KINDS)
def test_bags_of_another_writer(tmp_path, mode, storage):
    actual = images(foreign_bag(tmp_path / "bag", mode, storage))
    assert len(actual) == 2
    for image in actual:
        np.testing.assert_array_equal(image, PIXELS.reshape(2, 4, 3))


@pytest.mark.parametrize(("mode", "storage"), [kind for kind in KINDS if kind[0] != "NONE"])
def test_compressed_bags_that_expand_beyond_the_limit(tmp_path, small_limit, mode, storage):
    path = foreign_bag(tmp_path / "bag", mode, storage, BLACK[: 2**22 // 12 * 12])
    with pytest.raises(fs.InputError, match=r"must expand to at most 2.*FIDSPLAT_INPUT_LIMIT="):
        images(path)


def test_a_compressed_bag_of_several_frames(tmp_path, small_limit):
    """The first frame alone declares a small size."""
    import zstandard

    path = foreign_bag(tmp_path / "bag", "FILE")
    (file,) = path.glob("*.zstd")
    file.write_bytes(b"".join(zstandard.compress(BLACK[: 2**20].tobytes()) for _ in range(4)))
    with pytest.raises(fs.InputError, match="must expand to at most 2"):
        images(path)


@pytest.mark.parametrize("declared", [1000, 2**20])
def test_a_chunk_that_expands_to_more_than_it_declares(tmp_path, monkeypatch, small_limit, declared):
    compressor = lz4.LZ4FrameCompressor()  # declares no size in its frame
    black = compressor.begin() + compressor.compress(BLACK.tobytes()) + compressor.flush()
    monkeypatch.setattr(lz4, "compress", lambda _: black)
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        bag = writer.Writer(stream, compression=writer.CompressionType.LZ4)
        bag.start()
        schema = bag.register_schema("sensor_msgs/msg/Image", "ros2msg", b"")
        bag.add_message(bag.register_channel("/a", "cdr", schema), 0, bytes(declared), 0)
        bag.finish()
    with pytest.raises(fs.InputError, match=r"a chunk must expand to the .* that it declares, got more"):
        images(path)


@pytest.mark.parametrize("name", ["a bag?", "#1", "50%41", "a?b#c%d/run?mode=rw"])
def test_names_that_a_uri_would_split(tmp_path, name):
    from fidsplat.logs import RobotLog

    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    for _ in range(2):
        with RobotLog(path, overwrite=True) as log:
            log.image(0.5, "front", PIXELS.reshape(2, 4, 3) / np.float32(255))
    np.testing.assert_array_equal(images(path), [PIXELS.reshape(2, 4, 3)])
    assert [p.name for p in path.parent.iterdir()] == [path.name]
    moved = path.rename(tmp_path / "moved")
    with highlevel.AnyReader([moved]) as reader:
        assert len(list(reader.messages())) == 1


MERGES = "a0: &a0 {x: 1}\n" + "".join(f"a{k + 1}: &a{k + 1} {{<<: [*a{k}, *a{k}]}}\n" for k in range(30))
KEY = "rosbag2_bagfile_information"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (MERGES, "merge"),
        ("[" * 100_000, "cannot read .* as a log"),
        ("#" * 2**20 + "\n", "at most 1,048,576 bytes"),
        (f"{KEY}: 1", "cannot read .* as a log"),
        (f"{KEY}: {{relative_file_paths: [../a.db3]}}", "cannot read"),
        (f"{KEY}: {{relative_file_paths: [], compression_mode: x}}", "must be zstd"),
        (
            f"{KEY}: {{relative_file_paths: [], compression_mode: file, compression_format: lz4}}",
            "zstd .* lz4",
        ),
        (f"{KEY}: {{relative_file_paths: [], compression_mode: message}}", "must be zstd"),
        (f"{KEY}: {{relative_file_paths: [], compression_mode: 1}}", "cannot read .* as a log"),
    ],
)
def test_metadata_that_is_not_of_a_bag(tmp_path, text, words):
    (tmp_path / "bag").mkdir()
    (tmp_path / "a.db3").write_bytes(b"")
    (tmp_path / "bag/metadata.yaml").write_text(text)
    begun = time.process_time()
    with pytest.raises(fs.InputError, match=words):
        images(tmp_path / "bag")
    assert time.process_time() - begun < 5


@pytest.mark.parametrize(
    "definition",
    [
        "CREATE TABLE messages(id, topic_id, timestamp, data AS (zeroblob(900000000)))",
        "CREATE TABLE messages(id, topic_id, timestamp DEFAULT 'x', data)",
        "CREATE TABLE messages(id, topic_id, timestamp, data TEXT DEFAULT 'x')",
        "CREATE VIEW messages AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n)"
        " SELECT 1 AS topic_id, max(i) AS timestamp, 1 AS data FROM n",
    ],
)
def test_databases_that_compute_what_no_file_holds(tmp_path, definition):
    path = foreign_bag(tmp_path / "bag")
    (file,) = path.glob("*.db3")
    with sqlite3.connect(file) as database:
        database.execute("DROP TABLE messages")
        database.execute(definition)
        if "TABLE" in definition:
            database.execute("INSERT INTO messages(id, topic_id) VALUES(1, 1)")
    database.close()
    with pytest.raises(fs.InputError, match="bag"):
        images(path)
