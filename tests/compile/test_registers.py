"""Registers and spills of kernels without effects, where the driver reports them."""

import json
import shutil
import subprocess

import pytest
from registers import RECORD, generation, measure, of_log

BACKEND = "opencl"
RECORD_IT = "PYTHONPATH=. python tests/registers.py --record"
PTX = """
.version 8.0
.target sm_90
.address_size 64
.visible .entry blend(.param .u64 out) {
    .reg .b64 %to; .reg .b32 %at; .shared .b8 staged[64];
    ld.param.u64 %to, [out]; mov.u32 %at, staged; bar.sync 0; st.global.u32 [%to], %at; ret;
}
.visible .entry project(.param .u64 out) {
    .reg .b64 %to, %at; .local .b8 kept[512];
    ld.param.u64 %to, [out]; mov.u64 %at, kept; cvta.local.u64 %at, %at; st.global.u64 [%to], %at; ret;
}
"""
LOG = """ptxas info    : 0 bytes gmem
ptxas info    : Compiling entry function 'emit' for 'sm_90'
ptxas info    : Function properties for helper
    64 bytes stack frame, 1 bytes spill stores, 2 bytes spill loads
ptxas info    : Function properties for emit
ptxas         .     24 bytes stack frame, 16 bytes spill stores, 8 bytes spill loads
ptxas info    : Used 96 registers, 400 bytes cmem[0]
ptxas info    : Compiling entry function 'emit_more' for 'sm_90'
ptxas info    : Function properties for emit_more
    0 bytes stack frame, 0 bytes spill stores, 0 bytes spill loads
ptxas info    : Used 8 registers, used 1 barriers
"""


def test_the_log_of_the_assembler_is_read():
    assert of_log(LOG) == {
        "emit": {"registers": 96, "stack": 24, "spill_stores": 16, "spill_loads": 8},
        "emit_more": {"registers": 8, "stack": 0, "spill_stores": 0, "spill_loads": 0},
    }
    assert of_log("") == {}


@pytest.mark.skipif(not shutil.which("ptxas"), reason="NVIDIA's assembler is not installed")
def test_the_log_of_this_assembler_is_read(tmp_path):
    file = tmp_path / "kernels.ptx"
    file.write_text(PTX)
    process = subprocess.run(
        ["ptxas", "-v", "-arch=sm_90", "-o", str(tmp_path / "kernels.cubin"), str(file)],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    actual = of_log(process.stderr)
    assert actual.keys() == {"blend", "project"}
    assert actual["project"]["stack"] == 512
    assert all(0 < numbers["registers"] < 64 for numbers in actual.values())


def test_registers_without_effects_equal_the_record(renderer):
    """A change of a stage records new numbers; an effect must not change them."""
    backend = renderer.backend
    kind = generation(backend)
    if kind is None:
        pytest.skip("only NVIDIA's driver reports registers")
    recorded = json.loads(RECORD.read_text("utf-8")).get(kind)
    driver = backend.device.driver_version
    if recorded is None or recorded["driver"] != driver:
        pytest.skip(f"no record for {kind} with driver {driver}; make one: {RECORD_IT}")
    assert measure(backend) == recorded["kernels"]
