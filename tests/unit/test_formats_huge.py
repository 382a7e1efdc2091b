"""Files of gigabytes: other formats are recognised by their first bytes, and no more is read than
necessary."""

import base64
import json
import tracemalloc

import pytest
from test_formats import USD, assert_same_bits, need, some

import fidsplat as fs

HUGE = 5 * 10**9


@pytest.mark.parametrize("suffix", [".sog", ".ply", ".spz", ".glb", ".gltf", ".splat", *USD[1:2]])
def test_a_huge_file_that_is_something_else_is_not_read_as_a_whole(tmp_path, suffix):
    need(suffix)
    path = tmp_path / f"a{suffix}"
    with path.open("wb") as stream:
        stream.truncate(HUGE)  # of zeros, which take no room on a disk
    tracemalloc.start()
    try:
        with pytest.raises(fs.InputError, match=str(path)):
            fs.load_splats(path)
        assert tracemalloc.get_traced_memory()[1] < 10**8
    finally:
        tracemalloc.stop()


def test_only_the_splats_of_a_huge_file_next_to_a_gltf_are_read(tmp_path):
    cloud, path, beside = some(count=9), tmp_path / "a.gltf", tmp_path / "data.bin"
    fs.save_splats(cloud, path)
    document = json.loads(path.read_bytes())
    beside.write_bytes(base64.b64decode(document["buffers"][0]["uri"].partition(",")[2]))
    document["buffers"][0]["uri"] = beside.name
    path.write_text(json.dumps(document))
    with beside.open("r+b") as stream:
        stream.truncate(HUGE)
    tracemalloc.start()
    try:
        assert_same_bits(fs.load_splats(path), cloud)
        assert tracemalloc.get_traced_memory()[1] < 10**8
    finally:
        tracemalloc.stop()
