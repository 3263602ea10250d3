"""What a run leaves behind: files whole or not at all, known when damaged, and held by one."""

import hashlib
import io
import os
import shutil
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from helpers import ROOT

from rps_jax import engines
from rps_jax.engines import device
from rps_jax.errors import InputError
from rps_jax.record import files, provenance
from rps_jax.record import folder as run_folder
from rps_jax.record.checkpoint import Checkpoints

RESULTS = xr.Dataset(
    {"time": (("law", "world"), np.linspace(0, 1, 200, dtype=np.float32).reshape(2, 100))},
    {"law": ["rps", "nps"]},
)


def state(generation):
    """Of a search, as it is kept between two generations."""
    file = io.BytesIO()
    np.savez(file, mean=np.arange(12.0), generation=generation)
    return file.getvalue()


# --- damage --------------------------------------------------------------------------------


def truncated(share):
    return lambda content: content[: int(share * len(content))]


def flipped(share, bit):
    def flip(content):
        at = int(share * len(content))
        return content[:at] + bytes([content[at] ^ 1 << bit]) + content[at + 1 :]

    return flip


def blank(share, size):
    """A block of zeros; of ones where there are zeros already."""

    def fill(content):
        at = int(share * len(content))
        block = content[at : at + size]
        fills = (bytes(len(block)), b"\xff" * len(block))
        return content[:at] + next(f for f in fills if f != block) + content[at + size :]

    return fill


SHARES = (0, 0.001, 0.01, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 0.97, 0.999)
DAMAGE = {
    **{f"cut at {share}": truncated(share) for share in SHARES},
    **{f"bit {i % 8} at {share}": flipped(share, i % 8) for i, share in enumerate(SHARES)},
    **{f"block at {share}": blank(share, 64) for share in SHARES},
    **{f"byte at {share}": blank(share, 1) for share in SHARES[::2]},
    "all zeros": lambda content: bytes(len(content)),
    "one byte more": lambda content: content + b"\0",
    "twice": lambda content: content * 2,
    "halves swapped": lambda content: content[len(content) // 2 :] + content[: len(content) // 2],
    "backwards": lambda content: content[::-1],
    "text": lambda content: b"this is a note\n",
    "HDF5 in name": lambda content: b"\x89HDF\r\n\x1a\n" + bytes(500),
    "zip in name": lambda content: b"PK\x03\x04" + bytes(500),
    "JSON of something else": lambda content: b'{"worlds": 7}\n',
    "deep JSON": lambda content: b"[" * 100_000,
    "another run's results": lambda content: files.encode_results(RESULTS + 1),
    "another search's state": lambda content: state(99),
}


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """A run folder with everything in it."""
    folder = tmp_path_factory.mktemp("run") / "run"
    run_folder.claim(folder, {"worlds": 300, "seed": 0})
    provenance.write_environment(folder, {"command": ["rps", "sweep"], "time": "now"})
    files.write_results(folder / "results.nc", RESULTS)
    parts = Checkpoints(folder)
    for number in range(3):
        parts.put(f"{number:07d}", files.encode_results(RESULTS.isel(world=[number])))
    parts.put("state", state(4), ".npz")
    return folder


@pytest.fixture
def folder(sound, tmp_path, monkeypatch):
    """A copy of it, and nothing that is damaged may come to HDF5."""
    monkeypatch.setattr(xr, "load_dataset", lambda *_, **__: pytest.fail("HDF5 opened a file"))
    return shutil.copytree(sound, tmp_path / "run")


def in_one_sentence(path, read, *arguments):
    with pytest.raises(InputError) as caught:
        read(*arguments)
    told = str(caught.value)
    assert told.startswith(f"{path} is corrupt")
    assert told.endswith(".")
    assert "\n" not in told


@pytest.mark.parametrize("damage", DAMAGE)
def test_damage_is_known_before_anything_reads_it_and_nothing_else_is_lost(damage, folder):
    parts, before = Checkpoints(folder), dict(Checkpoints(folder).items())
    began = time.perf_counter()
    for name, path in parts.paths().items():
        damaged = DAMAGE[damage](before[name])
        path.write_bytes(damaged)
        assert parts.get(name) is None
        assert path.with_name(f"{path.name}.corrupt").read_bytes() == damaged
        others = {other: content for other, content in before.items() if other != name}
        assert dict(parts.items()) == others
        parts.put(name, before[name], path.suffix)
    assert dict(parts.items()) == before
    for name, *readers in (
        ("results.nc", files.read_results),
        ("manifest.json", run_folder.read_manifest, lambda f: run_folder.claim(f, {"worlds": 300})),
        (
            "environment.json",
            provenance.describe,
            lambda f: provenance.write_environment(f, {"time": "later"}),
        ),
    ):
        path = folder / name
        content = path.read_bytes()
        damaged = DAMAGE[damage](content)
        path.write_bytes(damaged)
        for read in readers:
            in_one_sentence(path, read, folder)
        assert path.read_bytes() == damaged  # it is kept
        path.write_bytes(content)
    assert time.perf_counter() - began < 1.0
    assert len(DAMAGE) >= 50


def test_a_wrong_digest_is_damage_too(folder):
    path = Checkpoints(folder).paths()["0000001"]
    path.rename(path.with_name("0000001-0123456789abcdef.nc"))
    assert list(Checkpoints(folder).paths()) == ["0000000", "0000002", "state"]
    for other in ("0" * 64, "", "\N{SNOWMAN}"):
        files.checksum_path(folder / "results.nc").write_text(f"{other}  results.nc\n")
        in_one_sentence(folder / "results.nc", files.read_results, folder)


@pytest.mark.parametrize(
    "content", [b"", b"torn", b"\xff\xfe", b"[1]", b"[" * 100_000, b"{'a': 1}"]
)
def test_a_file_without_checksum_that_is_no_json_is_named(content, folder):
    """As an older version left it."""
    for name, read in (
        ("manifest.json", run_folder.read_manifest),
        ("environment.json", provenance.describe),
    ):
        files.checksum_path(folder / name).unlink()
        (folder / name).write_bytes(content)
        in_one_sentence(folder / name, read, folder)


def test_a_file_without_checksum_is_read(sound, tmp_path):
    """As an older version left it."""
    folder = shutil.copytree(sound, tmp_path / "run")
    for path in folder.glob("*.sha256"):
        path.unlink()
    xr.testing.assert_identical(files.read_results(folder), RESULTS)
    assert run_folder.read_manifest(folder) == {"worlds": 300, "seed": 0}
    provenance.write_environment(folder, {"time": "later"})
    assert provenance.read_environment(folder)["before"] == [
        {"command": ["rps", "sweep"], "time": "now"}
    ]
    (folder / "results.nc").write_bytes(b"torn")
    in_one_sentence(folder / "results.nc", files.read_results, folder)


def test_a_part_is_named_by_its_number_and_digest(tmp_path):
    """As every version names it, so that a sweep goes on that another version began."""
    content = files.encode_results(RESULTS.assign_attrs(part="0000012"))
    digest = hashlib.sha256(content).hexdigest()[:16]
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / f"0000012-{digest}.nc").write_bytes(content)
    assert dict(Checkpoints(tmp_path).items()) == {"0000012": content}
    assert Checkpoints(tmp_path).put("0000012", content) == Checkpoints(tmp_path).paths()["0000012"]
    results = Checkpoints(tmp_path).load_or_compute(
        "0000012", lambda: pytest.fail("it was made again")
    )
    xr.testing.assert_identical(results, RESULTS)
    xr.testing.assert_identical(
        Checkpoints(tmp_path).load_or_compute("other", lambda: RESULTS), RESULTS
    )
    assert list(Checkpoints(tmp_path).paths()) == ["0000012", "other"]


@pytest.mark.skipif(not shutil.which("sha256sum"), reason="there is no sha256sum")
def test_sha256sum_checks_what_was_written(sound):
    check = ["sha256sum", "-c", *(path.name for path in sound.glob("*.sha256"))]
    done = subprocess.run(check, cwd=sound, capture_output=True, text=True, check=True)
    assert set(done.stdout.split("\n")[:-1]) == {
        f"{name}: OK" for name in ("results.nc", "manifest.json", "environment.json")
    }


# --- kills ---------------------------------------------------------------------------------


class Killed(BaseException):
    """What nothing catches."""


def killed_everywhere(monkeypatch, act, check):
    """Act, and be killed before the first, the second, ... of its calls that change a disk."""
    owners = ((os, "replace"), (os, "fsync"), (Path, "unlink"), (Path, "write_bytes"))
    for kill in range(100):
        left = [kill]

        def dies(call, left=left):
            def called(*arguments, **options):
                left[0] -= 1
                if left[0] < 0:
                    raise Killed
                return call(*arguments, **options)

            return called

        with monkeypatch.context() as patch:
            for owner, name in owners:
                patch.setattr(owner, name, dies(getattr(owner, name)))
            try:
                act()
            except Killed:
                pass
            else:
                return kill
        check()
    raise AssertionError("it never ends")


def test_a_write_killed_at_any_moment_leaves_the_old_file_or_the_new(tmp_path, monkeypatch):
    path, seen = tmp_path / "results.nc", set()

    def check():
        seen.add(files.read_checked(path))
        if files.checksum_path(path).exists():
            stated = files.checksum_path(path).read_text().split()[0]
            assert stated == hashlib.sha256(path.read_bytes()).hexdigest()
        files.write_bytes(path, b"old", checked=True)

    files.write_bytes(path, b"old", checked=True)
    write = lambda: files.write_bytes(path, b"new", checked=True)  # noqa: E731
    assert killed_everywhere(monkeypatch, write, check) > 6
    assert seen == {b"old", b"new"}
    assert files.checksum_path(path).exists()


def test_a_part_that_is_replaced_is_the_old_one_or_the_new(tmp_path, monkeypatch):
    """Whenever the process is killed."""
    parts, seen = Checkpoints(tmp_path), set()

    def check():
        seen.add(parts.get("state"))
        parts.put("state", state(1), ".npz")

    parts.put("state", state(1), ".npz")
    parts.put("state-of-another", b"other")
    put = lambda: parts.put("state", state(2), ".npz")  # noqa: E731
    assert killed_everywhere(monkeypatch, put, check) > 3
    assert seen == {state(1), state(2)}
    assert len(list(parts.folder.glob("[!.]*"))) == 2


def test_of_two_files_of_a_part_the_newer_counts_if_it_is_sound(tmp_path):
    parts = Checkpoints(tmp_path)
    for age, content in ((100, b"old"), (0, b"new")):
        path = parts.put("state", content, new=True)
        os.utime(path, (time.time() - age,) * 2)
    assert dict(parts.items()) == {"state": b"new"}
    parts.paths()["state"].write_bytes(b"torn")
    assert dict(parts.items()) == {"state": b"old"}


# --- one at a time -------------------------------------------------------------------------


def refused(folder, number=1, of=1):
    with pytest.raises(InputError, match="in use by another process"):
        run_folder.lock(folder, number, of).__enter__()


def test_two_processes_may_not_share_a_run_but_may_share_its_shards(tmp_path):
    with run_folder.lock(tmp_path):
        refused(tmp_path)
        refused(tmp_path, 1, 2)
    with run_folder.lock(tmp_path, 1, 2):
        with run_folder.lock(tmp_path, 2, 2):
            refused(tmp_path, 1, 2)
        refused(tmp_path)
        refused(tmp_path, 2, 3)  # which has parts of both
    with run_folder.lock(tmp_path, 1, 3):
        pass


_HOLDER = """
import sys
from pathlib import Path
from rps_jax.record import checkpoint, files, provenance
from rps_jax.record import folder as run_folder
assert "jax" not in sys.modules
with run_folder.lock(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


def test_a_killed_process_holds_nothing_and_the_record_needs_no_jax(tmp_path):
    command = [sys.executable, "-c", _HOLDER, str(tmp_path)]
    with subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as one:
        assert one.stdout.readline() == b"held\n"
        refused(tmp_path)
        one.kill()
        one.wait()
        with run_folder.lock(tmp_path):
            pass


def test_of_those_that_begin_a_run_at_once_all_agree_or_are_refused(tmp_path):
    """Threads, whose file locks are as much each one's own as those of processes."""
    together = threading.Barrier(8)

    def begin(number):
        wanted = {"worlds": number % 2}
        together.wait()
        try:
            run_folder.claim(tmp_path, wanted)
        except InputError as error:
            return str(error)
        provenance.write_environment(tmp_path, {"time": number})
        return wanted

    with ThreadPoolExecutor(8) as pool:
        told = list(pool.map(begin, range(8)))
    kept = run_folder.read_manifest(tmp_path)
    assert sorted(t == kept for t in told) == [False] * 4 + [True] * 4
    assert all("holds another run" in t for t in told if t != kept)
    assert provenance.read_environment(tmp_path)["time"] in range(8)


def test_what_a_run_was_made_on_before_is_not_forgotten(tmp_path):
    this = device.collect_environment()
    there = this | {"commit": "abc", "device": this["device"] | {"kind": "H200"}, "time": "then"}
    provenance.write_environment(tmp_path, there)
    provenance.write_environment(tmp_path, this)
    provenance.write_environment(tmp_path, this | {"processors": 99})  # of a cluster that grows
    provenance.write_environment(tmp_path, this)
    provenance.write_environment(tmp_path, this | {"time": "later"})  # the same command again
    assert provenance.read_environment(tmp_path) == this | {"time": "later", "before": [there]}
    text = provenance.describe(tmp_path)
    assert text.index("later") < text.index("before that by") < text.index("commit abc, then, on H")
    (tmp_path / provenance.ENVIRONMENT).write_text("{}")
    with pytest.raises(InputError, match=r"environment\.json is corrupt"):
        provenance.describe(tmp_path)


def test_names_that_are_no_utf8_keep_their_bytes(tmp_path):
    """As in the C locale, where Python reads a snowman in a path as three lone surrogates."""
    name = "\N{SNOWMAN}".encode().decode("ascii", errors="surrogateescape")
    path = files.write_text(tmp_path / "report.md", f"run folder: {name}")
    assert path.read_bytes() == "run folder: \N{SNOWMAN}".encode()


def test_only_processors_that_a_process_may_use_are_counted(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {3, 7, 8}, raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 128)
    assert engines.get("fused").workers("cpu") == 3
    monkeypatch.delattr(os, "sched_getaffinity")
    assert device.count_processors() == 128
