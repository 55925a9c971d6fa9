"""`doctor` and `warmup`, and machines that lack something: no device, no room, no place to write."""

import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import warp as wp

from tests.test_writers import full_disk
from warp_rigid.commands import cli
from warp_rigid.diagnostics import machine, selftest
from warp_rigid.engine.loading import everything, load_kernels
from warp_rigid.engine.simulator import choose_device
from warp_rigid.scene.shapes import distance_grid

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def quick(monkeypatch):
    """The speed is measured for a moment only."""
    monkeypatch.setattr(selftest, "SECONDS", 0.05)


def run(capsys, *arguments):
    status = cli.main(list(arguments))
    captured = capsys.readouterr()
    return status, captured.out, captured.err


def fresh(*arguments, **environment):
    """A process of its own, with other environment variables."""
    command = [sys.executable, "-m", "warp_rigid", *arguments]
    return subprocess.run(
        command, cwd=ROOT, env={**os.environ, **environment}, capture_output=True, text=True, timeout=120
    )


@pytest.mark.long
def test_doctor_says_what_works(capsys):
    status, out, _ = run(capsys, "doctor", "--device", "cpu", "--json")
    report = json.loads(out)
    assert status == 0 and report["ok"]
    assert report["versions"]["warp-lang"] == wp.__version__
    assert [device["name"] for device in report["devices"]] == ["cpu"]
    assert report["devices"][0]["memory"] >= report["devices"][0]["free"] > 10**8
    assert report["thresholds"]["SLOP"]["value"] == 1e-4 and "fraction" in report["thresholds"]["SLOP"]["text"]
    names = [check["name"] for check in report["checks"] if check["passed"]]
    assert {"cuda", "kernel cache", "grid cache", "temporary files", "self-test on cpu"} <= {*names}


def test_the_self_test_holds_on_every_device(device, quick):
    result = selftest.self_test(device)
    assert all(result["checks"].values()) and len(result["checks"]) == 3
    assert result["steps_per_second"] > 10


def test_the_self_test_can_fail(quick, monkeypatch):
    monkeypatch.setattr(selftest, "STEPS", 0)
    sim = selftest.Simulator(selftest._scene(), num_envs=2, device="cpu")
    alone = selftest.Simulator(selftest._scene(), device="cpu")
    sim.set("position", (0, 0, 4.9), envs=[1])
    assert not selftest._falls(sim) and not selftest._stands(sim) and not selftest._alike(sim, alone)


def test_doctor_tells_what_to_do(capsys, monkeypatch, tmp_path):
    """A missing library, a folder that cannot be written, a full disk, a device that crashes, in plain words."""
    file = tmp_path / "file"
    file.write_text("")
    monkeypatch.setenv("WARP_RIGID_CACHE", str(file / "cache"))
    monkeypatch.setitem(machine.LIBRARIES, "no-such-library", "warp-rigid")
    monkeypatch.setattr(machine, "ENOUGH_DISK", 2**70)
    crashed = subprocess.CompletedProcess([], -11, "", "CUDA error 999: unknown error\n")
    monkeypatch.setattr(machine.subprocess, "run", lambda *_, **__: crashed)
    status, out, _ = run(capsys, "doctor", "--device", "cpu")
    assert status == 1
    assert "FAIL no-such-library: not installed" in out and "pip install 'warp-rigid'" in out
    assert f"FAIL grid cache: {file / 'cache'}: Not a directory" in out and "set WARP_RIGID_CACHE" in out
    assert "FAIL temporary files" in out and "free space on this disk" in out
    assert "FAIL self-test on cpu: CUDA error 999" in out


def test_a_self_test_that_hangs_or_computes_wrongly_is_told(monkeypatch):
    def hangs(*_, **__):
        raise subprocess.TimeoutExpired("x", 1)

    monkeypatch.setattr(machine.subprocess, "run", hangs)
    assert "not finished after" in machine._device("cuda:0").found
    wrong = json.dumps({"checks": {"a": True, "b": False}, "compile_seconds": 1, "steps_per_second": 1})
    done = subprocess.CompletedProcess([], 0, wrong + "\n", "")
    monkeypatch.setattr(machine.subprocess, "run", lambda *_, **__: done)
    check = machine._device("cuda:0")
    assert not check.passed and check.found == "failed: b" and "driver" in check.advice
    silent = subprocess.CompletedProcess([], -9, "", "")
    monkeypatch.setattr(machine.subprocess, "run", lambda *_, **__: silent)
    assert "status -9" in machine._device("cuda:0").found and "--device cpu" in machine._device("cuda:0").advice


def test_the_self_test_is_of_this_copy_of_the_package(monkeypatch):
    places = []

    def run(*_, env, **__):
        places.extend(env["PYTHONPATH"].split(os.pathsep))
        return subprocess.CompletedProcess([], 1, "", "")

    monkeypatch.setattr(machine.subprocess, "run", run)
    machine._device("cpu")
    assert Path(places[0], "warp_rigid").samefile(Path(machine.__file__).parents[1])


def test_a_driver_that_warp_cannot_use_is_a_fault(monkeypatch):
    monkeypatch.setattr(machine.wp, "is_cuda_available", lambda: False)
    monkeypatch.setattr(machine.shutil, "which", lambda _: "/usr/bin/nvidia-smi")
    check = machine._cuda()
    assert not check.passed and "update the NVIDIA driver" in check.advice
    monkeypatch.setattr(machine.shutil, "which", lambda _: None)
    monkeypatch.setattr(machine.Path, "exists", lambda _: False)
    assert machine._cuda().passed


def test_a_driver_older_than_cuda_12_4_is_named(monkeypatch, caplog):
    """Conditional nodes of CUDA graphs, with which a step repeats rounds, need it."""
    monkeypatch.setattr(machine.wp, "is_cuda_available", lambda: True)
    monkeypatch.setattr(machine.wp, "get_cuda_driver_version", lambda: (12, 2))
    monkeypatch.setattr(machine.wp, "is_conditional_graph_supported", lambda: False)
    check = machine._cuda()
    assert not check.passed and check.found.endswith("driver for CUDA 12.2") and "12.4" in check.advice
    assert str(choose_device(None)) == "cpu"
    assert "CUDA 12.4 or newer" in caplog.text
    monkeypatch.setattr(machine.wp, "get_device", lambda name: SimpleNamespace(is_cuda=True))
    with pytest.raises(ValueError, match=r"CUDA 12\.4 or newer; update it, or use cpu"):
        choose_device("cuda:0")
    monkeypatch.setattr(machine.wp, "is_conditional_graph_supported", lambda: True)
    assert machine._cuda().passed


def test_warmup_compiles_everything(capsys, monkeypatch):
    told = []

    def tell(ready, total):
        told.append((ready, total))

    load_kernels(wp.get_device("cpu"), everything(), on_module=tell)
    assert [ready for ready, _ in told] == list(range(1, told[0][1] + 1))
    assert {total for _, total in told} == {len(told)} and len(told) > 10
    status, out, _ = run(capsys, "warmup", "--device", "cpu")
    assert status == 0 and out.startswith("cpu: ready after")


@pytest.mark.parametrize("command", ["run", "doctor", "warmup"])
def test_a_device_that_is_not_there_is_one_line(capsys, command):
    arguments = ["incline"] if command == "run" else []
    status, out, err = run(capsys, command, *arguments, "--device", "cuda:99")
    assert status == 2 and out == ""
    assert err.splitlines()[-1].startswith("warp-rigid: device: must be one of ")


@pytest.mark.long
def test_a_kernel_cache_that_cannot_be_written_is_one_line(tmp_path):
    (tmp_path / "file").write_text("")
    done = fresh("run", "incline", WARP_CACHE_PATH=str(tmp_path / "file" / "x"))
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.splitlines()[-1].endswith("x: Not a directory; WARP_CACHE_PATH must be a writable folder")
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.long
def test_a_home_that_cannot_be_written_is_no_error(tmp_path):
    """Grids are then computed anew by every process; Warp's kernels are where WARP_CACHE_PATH says."""
    cache = str(Path(wp.config.kernel_cache_dir).parent)
    nowhere = {"HOME": "/proc/nowhere", "XDG_CACHE_HOME": "/proc/nowhere", "WARP_RIGID_CACHE": ""}
    done = fresh("inspect", "tetrahedron", "--sdf-resolution", "8", WARP_CACHE_PATH=cache, **nowhere)
    assert done.returncode == 0 and done.stderr == ""
    assert "4 vertices" in done.stdout


@pytest.mark.long
def test_nothing_needs_shared_memory():
    """The package opens nothing under /dev/shm and shares no memory between processes: containers need none."""
    code = (
        "import sys; seen = []\n"
        "sys.addaudithook(lambda name, arguments: seen.append(arguments[0]) if name == 'open' else None)\n"
        "from warp_rigid.diagnostics import selftest; selftest.SECONDS = 0.05; selftest.self_test('cpu')\n"
        "used = [x for x in seen if str(x).startswith('/dev/shm')] + [m for m in sys.modules if 'shared_memory' in m]\n"
        "sys.exit(str(used) if used else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr


def test_a_device_that_breaks_while_running_is_one_line(capsys, monkeypatch):
    """What Warp raises when a device is lost or out of memory; other errors keep their traceback."""
    from warp_rigid.runs import runner

    def broken(text):
        def execute(*_, **__):
            raise RuntimeError(text)

        monkeypatch.setattr(runner, "execute", execute)

    broken("CUDA error 719: unspecified launch failure")
    status, _, err = run(capsys, "run", "incline", "--device", "cpu")
    assert status == 1 and "CUDA error 719" in err.splitlines()[-1] and "warp-rigid doctor" in err.splitlines()[-1]
    broken("Failed to allocate 10 bytes on device 'cuda:0'")
    assert run(capsys, "run", "incline", "--device", "cpu")[0] == 1
    broken("a fault of the program")
    with pytest.raises(RuntimeError, match="a fault"):
        cli.main(["run", "incline", "--device", "cpu"])


@pytest.mark.parametrize(
    ("name", "flags"),
    [
        ("a.glb", ["-o"]),
        ("a.png", ["--picture"]),
        ("a.gif", ["--film"]),
        ("a.mp4", ["--film"]),
        ("a.html", ["--html"]),
        ("a.ckpt", ["--checkpoint-every", "1", "--checkpoint"]),
        ("a.usdc", ["-o"]),
        ("a.usdz", ["-o"]),
    ],
)
def test_a_disk_that_becomes_full_leaves_the_old_file(capsys, tmp_path, name, flags):
    """One line names the file."""
    path = tmp_path / name
    arguments = ["run", "incline", "--frames", "2", "--device", "cpu", *flags, str(path)]
    path.write_bytes(b"old")
    with full_disk():
        status, out, err = run(capsys, *arguments)
    assert status == 2 and "wrote" not in out
    assert err.splitlines()[-1].startswith(f"warp-rigid: {path}: ")
    assert [file.name for file in tmp_path.iterdir()] == [name]
    assert path.read_bytes() == b"old"


def test_a_disk_that_becomes_full_leaves_the_old_table(capsys, tmp_path):
    arguments = ["sweep", "incline", "--vary", "friction=0.1,0.2", "--duration", "0.01"]
    outputs = ["--plot", str(tmp_path / "t.svg"), "--overwrite", "-o", str(tmp_path / "t.parquet")]
    assert run(capsys, *arguments, *outputs)[0] == 0
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    with full_disk():
        for output in (outputs[:2], outputs[2:]):
            status, _, err = run(capsys, *arguments, *output)
            assert status == 2 and err.splitlines()[-1] == f"warp-rigid: {output[-1]}: File too large"
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before


@pytest.mark.long
def test_a_home_without_room_for_kernels_is_one_line():
    """Nothing is set: Warp would keep its kernels below a home that cannot be written."""
    places = ("WARP_CACHE_PATH", "XDG_CACHE_HOME", "HOME")
    environment = {name: value for name, value in os.environ.items() if name not in places}
    command = [sys.executable, "-m", "warp_rigid", "run", "incline"]
    environment["HOME"] = "/proc/nowhere"
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 2 and done.stdout == ""
    assert "WARP_CACHE_PATH must be a writable folder" in done.stderr.splitlines()[-1]


def test_caches_have_a_place_on_every_system(monkeypatch):
    monkeypatch.delenv("WARP_RIGID_CACHE")
    for platform, names, tail in (
        ("linux", {"XDG_CACHE_HOME": "/x"}, "/x/warp_rigid"),
        ("darwin", {"HOME": "/h"}, "/h/Library/Caches/warp_rigid"),
        ("win32", {"LOCALAPPDATA": "/l"}, "/l/warp_rigid"),
    ):
        monkeypatch.setattr(distance_grid.sys, "platform", platform)
        for name, value in names.items():
            monkeypatch.setenv(name, value)
        assert distance_grid.cache_folder().as_posix() == tail
