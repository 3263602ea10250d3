"""Files of a run: atomic writes, detection of damage, and locks."""

import contextlib
import hashlib
import io
import itertools
import os
import re
import shutil
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from helpers import ROOT, refusing

import rps_jax
from rps_jax import engines
from rps_jax.engines import device
from rps_jax.errors import InputError
from rps_jax.record import files, provenance
from rps_jax.record import folder as run_folder
from rps_jax.record.checkpoint import Checkpoints
from rps_jax.runs.sweep import Sweep

TIMES = np.linspace(0, 1, 200, dtype=np.float32).reshape(2, 100)
RESULTS = xr.Dataset({"time": (("law", "world"), TIMES)}, {"law": ["rps", "nps"]})


def state(generation):
    """Return the checkpoint of a search after a generation."""
    file = io.BytesIO()
    np.savez(file, mean=np.arange(12.0), generation=generation)
    return file.getvalue()


# --- damage --------------------------------------------------------------------------------


def truncated(content, at):
    return content[:at]


def flipped(content, at):
    return content[:at] + bytes([content[at] ^ 1 << at % 8]) + content[at + 1 :]


def overwritten(content, at, size=64):
    """Overwrite a block with zeros, or with ones where it is zero already."""
    block = content[at : at + size]
    fills = (bytes(len(block)), b"\xff" * len(block))
    return content[:at] + next(f for f in fills if f != block) + content[at + size :]


def at_share(damage, share):
    """Return the function that damages a content at a share of its length."""
    return lambda content: damage(content, int(share * len(content)))


SHARES = (0, 0.01, 0.5, 0.999)
DAMAGE = {
    **{f"cut at {share}": at_share(truncated, share) for share in SHARES},
    **{f"bit at {share}": at_share(flipped, share) for share in SHARES},
    **{f"block at {share}": at_share(overwritten, share) for share in SHARES},
    "all zeros": lambda content: bytes(len(content)),
    "one byte more": lambda content: content + b"\0",
    "twice": lambda content: content * 2,
    "HDF5 in name": lambda content: b"\x89HDF\r\n\x1a\n" + bytes(500),
    "zip in name": lambda content: b"PK\x03\x04" + bytes(500),
    "JSON of something else": lambda content: b'{"worlds": 7}\n',
    "deep JSON": lambda content: b"[" * 100_000,
    "another run's results": lambda content: files.encode_results(RESULTS + 1),
    "another search's state": lambda content: state(99),
}


def test_a_printed_command_has_the_files_that_ran_before(monkeypatch):
    monkeypatch.setattr("sys.argv", ["rps", "a.py", "b.py", "sweep", "--laws", "c.py"])
    assert provenance.shell("replay", "my run", 3) == "rps a.py b.py replay 'my run' 3"


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """A run folder with everything in it."""
    folder = tmp_path_factory.mktemp("run") / "run"
    run_folder.claim(folder, {"worlds": 300, "seed": 0})
    provenance.write_environment(folder, {"command": ["rps", "sweep"], "time": "now"})
    files.write_results(folder / "results.nc", RESULTS)
    parts = Checkpoints(folder)
    for index in range(3):
        parts.put(f"{index:07d}", files.encode_results(RESULTS.isel(world=[index])))
    parts.put("state", state(4), ".npz")
    return folder


@pytest.fixture
def folder(sound, tmp_path, monkeypatch):
    """A copy of the run folder; HDF5 must not open damaged files."""
    monkeypatch.setattr(xr, "load_dataset", lambda *_, **__: pytest.fail("HDF5 opened a file"))
    return shutil.copytree(sound, tmp_path / "run")


def start_later(folder):
    provenance.write_environment(folder, {"time": "later"})


# The checked files of a run folder, and their readers.
READERS = {
    "results.nc": [files.read_results],
    "manifest.json": [run_folder.read_manifest, lambda f: run_folder.claim(f, {"worlds": 300})],
    "environment.json": [provenance.describe, start_later],
}


def reports_corruption(path):
    for read in READERS[path.name]:
        with pytest.raises(InputError) as caught:
            read(path.parent)
        assert re.fullmatch(rf"{re.escape(str(path))} is corrupt.*\.", str(caught.value))


@pytest.mark.parametrize("damage", DAMAGE)
def test_damage_is_detected_before_reading_and_other_files_survive(damage, folder):
    parts, contents = Checkpoints(folder), dict(Checkpoints(folder).items())
    start_time = time.perf_counter()
    for name, path in parts.paths().items():
        damaged = DAMAGE[damage](contents[name])
        path.write_bytes(damaged)
        assert parts.get(name) is None
        assert path.with_name(f"{path.name}.corrupt").read_bytes() == damaged
        rest = {key: content for key, content in contents.items() if key != name}
        assert dict(parts.items()) == rest
        parts.put(name, contents[name], path.suffix)
    assert dict(parts.items()) == contents
    for path in map(folder.joinpath, READERS):
        content = path.read_bytes()
        damaged = DAMAGE[damage](content)
        path.write_bytes(damaged)
        reports_corruption(path)
        assert path.read_bytes() == damaged  # the damaged file stays
        path.write_bytes(content)
    assert time.perf_counter() - start_time < 1.0


def test_a_wrong_digest_is_damage_too(folder):
    path = Checkpoints(folder).paths()["0000001"]
    path.rename(path.with_name("0000001-0123456789abcdef.nc"))
    assert list(Checkpoints(folder).paths()) == ["0000000", "0000002", "state"]
    for digest in ("0" * 64, "", "\N{SNOWMAN}"):
        files.checksum_path(folder / "results.nc").write_text(f"{digest}  results.nc\n")
        reports_corruption(folder / "results.nc")


INVALID_JSON = [b"", b"torn", b"\xff\xfe", b"[1]", b"[" * 100_000, b"{'a': 1}"]


@pytest.mark.parametrize("content", INVALID_JSON)
def test_invalid_json_without_checksum_is_reported(content, folder):
    """Older versions wrote no checksums."""
    for path in (folder / "manifest.json", folder / "environment.json"):
        files.checksum_path(path).unlink()
        path.write_bytes(content)
        reports_corruption(path)


def test_numbers_of_numpy_and_jax_are_those_of_python_in_a_run(tmp_path):
    for kind, seed in ((np.float32, np.uint32(3)), (jnp.float32, np.int64(3)), (float, 3)):
        domain = rps_jax.Domain(mass=rps_jax.Range(kind(4), kind(8)))
        sweep = Sweep("rps", domain, setting=rps_jax.Setting(seed=seed))
        run_folder.claim(tmp_path, sweep.configuration())


def test_fields_of_later_versions_are_absent_in_older_runs():
    """None says that a quantity is absent, so a run that lacks it goes on."""
    older, later = {"robot": {"mass": 9}}, {"robot": {"mass": 9, "radius": None}, "slope": None}
    assert run_folder.describe_difference(older, later) == ""
    assert run_folder.describe_difference(later, older) == ""
    later["robot"]["radius"] = 0.3
    words = run_folder.describe_difference(older, later)
    assert words == "robot.radius = None there, 0.3 asked for"


def test_a_file_without_checksum_is_read(sound, tmp_path):
    """Older versions wrote no checksums."""
    folder = shutil.copytree(sound, tmp_path / "run")
    for path in folder.glob("*.sha256"):
        path.unlink()
    xr.testing.assert_identical(files.read_results(folder), RESULTS)
    assert run_folder.read_manifest(folder) == {"worlds": 300, "seed": 0}
    start_later(folder)
    (previous,) = provenance.read_environment(folder)["before"]
    assert previous == {"command": ["rps", "sweep"], "time": "now"}
    (folder / "results.nc").write_bytes(b"torn")
    reports_corruption(folder / "results.nc")


def test_a_part_is_named_by_its_number_and_digest(tmp_path):
    """The name is stable, so that a sweep of another version can be resumed."""
    content = files.encode_results(RESULTS.assign_attrs(part="0000012"))
    digest = hashlib.sha256(content).hexdigest()[:16]
    parts, again = Checkpoints(tmp_path), lambda: pytest.fail("it was made again")
    parts.folder.mkdir()
    (parts.folder / f"0000012-{digest}.nc").write_bytes(content)
    assert dict(parts.items()) == {"0000012": content}
    assert parts.put("0000012", content) == parts.paths()["0000012"]
    xr.testing.assert_identical(parts.load_or_compute("0000012", again), RESULTS)
    xr.testing.assert_identical(parts.load_or_compute("other", lambda: RESULTS), RESULTS)
    assert list(parts.paths()) == ["0000012", "other"]


@pytest.mark.skipif(not shutil.which("sha256sum"), reason="there is no sha256sum")
def test_sha256sum_verifies_the_files(sound):
    check = ["sha256sum", "-c", *(path.name for path in sound.glob("*.sha256"))]
    done = subprocess.run(check, cwd=sound, capture_output=True, text=True, check=True)
    assert set(done.stdout.splitlines()) == {f"{name}: OK" for name in READERS}


# --- kills ---------------------------------------------------------------------------------


class Killed(BaseException):
    """Simulated SIGKILL, which no `except Exception` catches."""


def contents_after_kills(monkeypatch, read, write):
    """Return what is read after writes of `new` over `old`, killed at each change of the disk."""
    owners = ((os, "replace"), (os, "fsync"), (Path, "unlink"), (Path, "write_bytes"))
    contents = []
    while len(contents) < 100:
        write(b"old")
        calls = itertools.count()

        def dies(call, calls=calls):
            def called(*arguments, **options):
                if next(calls) >= len(contents):
                    raise Killed
                return call(*arguments, **options)

            return called

        with monkeypatch.context() as patch, contextlib.suppress(Killed):
            for owner, name in owners:
                patch.setattr(owner, name, dies(getattr(owner, name)))
            write(b"new")
            return contents
        contents.append(read())
    raise AssertionError("it never ends")


def test_a_write_killed_at_any_moment_leaves_the_old_file_or_the_new(tmp_path, monkeypatch):
    path = tmp_path / "results.nc"
    checksum = files.checksum_path(path)

    def read():
        if checksum.exists():
            stated = checksum.read_text().split()[0]
            assert stated == hashlib.sha256(path.read_bytes()).hexdigest()
        return files.read_checked(path)

    write = partial(files.write_bytes, path, checked=True)
    contents = contents_after_kills(monkeypatch, read, write)
    assert len(contents) > 6
    assert set(contents) == {b"old", b"new"}
    assert checksum.exists()


def test_a_killed_replacement_leaves_the_old_or_the_new_part(tmp_path, monkeypatch):
    parts = Checkpoints(tmp_path)
    parts.put("state-of-another", b"other")
    write = lambda content: parts.put("state", content, ".npz")  # noqa: E731
    contents = contents_after_kills(monkeypatch, lambda: parts.get("state"), write)
    assert len(contents) > 3
    assert set(contents) == {b"old", b"new"}
    assert len(list(parts.folder.glob("[!.]*"))) == 2


def test_the_newest_valid_file_of_a_part_is_read(tmp_path):
    parts = Checkpoints(tmp_path)
    for age, content in ((100, b"old"), (0, b"new")):
        path = parts.put("state", content, new=True)
        os.utime(path, (time.time() - age,) * 2)
    assert dict(parts.items()) == {"state": b"new"}
    parts.paths()["state"].write_bytes(b"torn")
    assert dict(parts.items()) == {"state": b"old"}


# --- one at a time -------------------------------------------------------------------------


def refused(folder, shard=1, num_shards=1):
    with refusing("in use by another process"):
        run_folder.lock(folder, shard, num_shards).__enter__()


def test_two_processes_may_not_share_a_run_but_may_share_its_shards(tmp_path):
    with run_folder.lock(tmp_path):
        refused(tmp_path)
        refused(tmp_path, 1, 2)
    with run_folder.lock(tmp_path, 1, 2):
        with run_folder.lock(tmp_path, 2, 2):
            refused(tmp_path, 1, 2)
        refused(tmp_path)
        refused(tmp_path, 2, 3)  # shard 2 of 3 has parts of both
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


def test_a_killed_process_releases_its_lock_and_the_record_needs_no_jax(tmp_path):
    command = [sys.executable, "-c", _HOLDER, str(tmp_path)]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen(command, cwd=ROOT, **pipes) as holder:
        assert holder.stdout.readline() == b"held\n"
        refused(tmp_path)
        holder.kill()
        holder.wait()
        with run_folder.lock(tmp_path):
            pass


def test_concurrent_starts_of_a_run_agree_or_are_refused(tmp_path):
    """Threads have separate file locks, as processes do."""
    together = threading.Barrier(8)

    def start_run(index):
        manifest = {"worlds": index % 2}
        together.wait()
        try:
            run_folder.claim(tmp_path, manifest)
        except InputError as error:
            return str(error)
        provenance.write_environment(tmp_path, {"time": index})
        return manifest

    with ThreadPoolExecutor(8) as pool:
        answers = list(pool.map(start_run, range(8)))
    stored = run_folder.read_manifest(tmp_path)
    assert sorted(answer == stored for answer in answers) == [False] * 4 + [True] * 4
    assert all("holds another run" in answer for answer in answers if answer != stored)
    assert provenance.read_environment(tmp_path)["time"] in range(8)


def test_previous_environments_of_a_run_are_kept(tmp_path):
    current = device.collect_environment()
    previous = current | {"commit": "abc", "time": "then"}
    previous["device"] = current["device"] | {"kind": "H200"}
    grown = current | {"processors": 99}  # as in a growing cluster
    last = current | {"time": "later"}  # the same command again
    for environment in (previous, current, grown, current, last):
        provenance.write_environment(tmp_path, environment)
    assert provenance.read_environment(tmp_path) == last | {"before": [previous]}
    text = provenance.describe(tmp_path)
    assert text.index("later") < text.index("before that by") < text.index("commit abc, then, on H")
    (tmp_path / provenance.ENVIRONMENT).write_text("{}")
    reports_corruption(tmp_path / provenance.ENVIRONMENT)


def test_an_editable_install_records_the_version_of_its_code(monkeypatch):
    """The metadata of an editable install stay those of the last installation."""
    monkeypatch.setattr(provenance.metadata, "version", lambda name: "0.0.1")
    versions = provenance.collect_environment()["packages"]
    assert (versions["rps_jax"], versions["jax"]) == (rps_jax.__version__, "0.0.1")


@pytest.mark.parametrize(("content", "commit"), [("node: abc\n", "abc"), (None, None)])
def test_an_archive_of_the_repository_knows_its_commit(content, commit, tmp_path, monkeypatch):
    """Git replaces the format of the file in an archive."""
    assert ".git_archival.txt export-subst" in (ROOT / ".gitattributes").read_text()
    content = content or (ROOT / ".git_archival.txt").read_text()
    (tmp_path / ".git_archival.txt").write_text(content)
    monkeypatch.setattr(provenance, "__file__", str(tmp_path / "rps_jax/record/provenance.py"))
    assert provenance.git_commit.__wrapped__() == commit


def test_paths_that_are_not_utf8_keep_their_bytes(tmp_path):
    """Python reads a snowman in a path as three lone surrogates in the C locale."""
    name = "\N{SNOWMAN}".encode().decode("ascii", errors="surrogateescape")
    path = files.write_text(tmp_path / "report.md", f"run folder: {name}")
    assert path.read_bytes() == "run folder: \N{SNOWMAN}".encode()


def test_only_processors_that_a_process_may_use_are_counted(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {3, 7, 8}, raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 128)
    assert engines.get("fused").workers("cpu") == 3
    monkeypatch.delattr(os, "sched_getaffinity")
    assert device.count_processors() == 128


def test_results_of_any_layout_and_type_are_read_as_written():
    """Long columns are compressed, which needs their bytes in order."""
    random = np.random.default_rng(0).random((2, 5000))
    columns = {
        "strided": random.T[:, ::-1],
        "single": random.T[:, 0].astype(np.float32),
        "flag": random.T[:, 0] > 0.5,
        "name": np.where(random.T[:, 0] > 0.5, "crate", "drum of steel"),
        "empty": np.zeros(5000),
        "nan": np.full(5000, np.nan),
    }
    dims = {name: ("world", "axis")[: column.ndim] for name, column in columns.items()}
    data = xr.Dataset({name: (dims[name], column) for name, column in columns.items()})
    content = files.encode_results(data)
    xr.testing.assert_identical(files.decode_results(content, "data"), data)
    assert len(content) < 0.9 * data.nbytes
