"""Hostile input ends in one kind of error, within bounded memory.

Run as ``python -m i2rl.analysis.benchmarks.faults.fuzz``.

Lines: lines of both formats are composed, with values now and then that JSON allows and readers must not,
mutated (characters replaced, inserted, deleted and repeated) and given to every reader of lines, and rows of
recordings of onions to theirs. Each line has to be read, or to end in the reader's own error, which names
file and line in at most a few hundred printable characters. Content that is read must be writable and read
back the same.

Archives: valid archives of processes are mutated byte by byte, and others are crafted to overwhelm or mislead
a reader (bombs, lies about sizes, encryption, other compressions, objects, absurd shapes and headers). Each
has to be read, or to end in a ``StorageError`` that names the file, and reading must allocate no more than
the limit it was given.
"""

from __future__ import annotations

import argparse
import io
import json
import random
import struct
import tempfile
import time
import tracemalloc
import warnings
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from resource import RUSAGE_SELF, getrusage
from typing import Any, NamedTuple

import numpy as np

from ....domains.labyrinth.process import HOME, destination, read_bouts
from ....domains.robots.onion_recordings import read_onion_recordings
from ....domains.robots.reaching import SIZE
from ....models.inputs.archives import StorageError
from ....models.observation.demonstration import (
    DEFAULT_LIMITS,
    DemonstrationError,
    LineLimits,
    read_trajectories,
    write_trajectories,
)
from ....models.observation.recordings import RecordingError
from ....models.observation.storage import load_mdp, save_mdp
from ....models.process.mdp import TabularMDP
from ..harness import print_table, publish

LONGEST_MESSAGE = 500
LIMIT = 2**22
"""Limit given to the reader of archives, in bytes."""


class Tally(NamedTuple):
    """Outcomes of inputs.

    Fields
    ------
    inputs : int
    read : int
        Accepted inputs; the reader refused the rest by its own error.
    problems : tuple of str
        All other outcomes, at most a hundred.
    seconds : float
    peak : int
        Largest memory allocated while reading one of them, in bytes; -1 if it was not measured.
    """

    inputs: int
    read: int
    problems: tuple[str, ...]
    seconds: float
    peak: int = -1


# -- lines --------------------------------------------------------------------------------------------


def tiny_process() -> TabularMDP:
    """Build a process of three named states and two named actions."""
    return TabularMDP.from_successors(
        np.zeros((3, 2, 1), int),
        np.ones((3, 2, 1)),
        np.zeros((3, 2, 1)),
        states=("bin", "the table", "größe"),
        actions=("grasp", "place"),
    )


_VALUES = (
    "null",
    "true",
    "false",
    "0",
    "-0",
    "1",
    "-1",
    "3",
    "127",
    "128",
    "1.0",
    "0.5",
    "1.5",
    "1e999",
    "-1e999",
    "NaN",
    "Infinity",
    "-Infinity",
    "99999999999999999999",
    "1" * 4301,
    "[]",
    "{}",
    "[[]]",
    '""',
    '"hidden"',
    '"s"',
    '"\\ud800"',
    '"\\u0000"',
    '"\\u001b[31m"',
    "[" * 500,
    "[" * 2000,
    '{"s":' * 300,
    '{"s": 1, "s": 2}',
    '"' + "x" * 5000 + '"',
    "\ufeff",
    "\x00",
    "\x1b[2J",
    "\u2028",
    "\ud800",
    "'bin'",
    "// no",
    "1_000",
    "٣",
)
_ALPHABET = '{}[]",:0123456789.eE+-satn \t\\/\x00\x7f\u00e9\u2028\U0001f400\ud800\ufeff'


_STEPS = {
    "s": ("0", "1", "2", '"bin"', '"the table"', '"größe"', "null"),
    "a": ("0", "1", '"grasp"', '"place"', "null"),
    "score": ("0", "1", "0.9", "1e-3", "null"),
}


def composed_trajectory(draws: random.Random) -> str:
    """Compose a line of a trajectory, valid but for a value now and then."""
    pick, chance = draws.choice, draws.random

    def value(valid: Sequence[str]) -> str:
        return pick(_VALUES) if chance() < 0.03 else pick(valid)

    def step() -> str:
        if chance() < 0.3:
            return pick(('"hidden"', "null"))
        names = [name for name in _STEPS if chance() < 0.7] or ["s"]
        return "{" + ", ".join(f'"{name}": {value(_STEPS[name])}' for name in names) + "}"

    steps = "[" + ", ".join(step() for _ in range(1 + draws.randrange(5))) + "]"
    if chance() < 0.3:
        return steps
    named = f'"id": {value(("3", chr(34) + "shift-7" + chr(34)))}, ' if chance() < 0.5 else ""
    return f'{{{named}"agent": {value(("0", "1", "null"))}, "steps": {steps}}}'


def composed_bout(draws: random.Random) -> str:
    """Compose a line of a walk in the labyrinth, valid but for a node or a frame now and then."""
    pick, chance = draws.choice, draws.random
    nodes = [0]
    for _ in range(1 + draws.randrange(8)):
        moves = [target for a in range(3) if (target := destination(nodes[-1], a)) is not None]
        nodes.append(pick(moves) if nodes[-1] != HOME else HOME)
        if nodes[-1] == HOME:
            break
    texts = [pick(_VALUES) if chance() < 0.01 else str(node) for node in nodes]
    frames = [pick(_VALUES) if chance() < 0.01 else str(10 * t + chance()) for t in range(len(nodes))]
    more = f', "frames": [{", ".join(frames)}]' if chance() < 0.5 else ""
    return f'{{"nodes": [{", ".join(texts)}]{more}}}'


def composed_row(draws: random.Random) -> str:
    """Compose a row of a recording of onions, valid but for a cell now and then."""
    cells = [draws.choice(("0.00", "0", "-0.0", "1e-3", " 0 ")) for _ in range(SIZE)]
    if draws.random() < 0.5:
        cells[draws.randrange(SIZE)] = draws.choice(_VALUES)
    return ",".join(cells)


def fuzzed_lines(seed: int, composed: Callable[[random.Random], str]) -> Iterator[str]:
    """Compose lines and mutate two in three, without end; the same way for the same seed."""
    draws = random.Random(seed)
    pick, below, chance = draws.choice, draws.randrange, draws.random
    while True:
        line = composed(draws)
        for _ in range(int(1.5 * chance() + 3 * chance() ** 4)):
            at, kind = below(len(line) + 1), chance()
            if kind < 0.3:
                line = line[:at] + pick(_ALPHABET) + line[at + 1 :]
            elif kind < 0.5:
                line = line[:at] + pick(_ALPHABET) + line[at:]
            elif kind < 0.65:
                line = line[:at] + line[at + 1 + below(8) :]
            elif kind < 0.75:
                line = line[:at] + line[at : at + below(30)] * below(4) + line[at:]
            elif kind < 0.95:  # a value in the place of another
                end = next((i for i in range(at, len(line)) if line[i] in ",:]}"), len(line))
                line = line[:at] + pick(_VALUES) + line[end:]
            else:
                line = line[:at]
        yield line if chance() < 0.9 else line + "\n"


def fuzz_lines(seed: int, n: int) -> dict[str, Tally]:
    """Give ``n`` fuzzed lines, as text and as bytes, to each reader of lines; a tally for each."""
    mdp = tiny_process()

    def trajectories(line: str | bytes) -> None:
        for record in read_trajectories(["\n", line], mdp, "log"):
            file = io.StringIO()
            write_trajectories(file, record.demonstration, mdp, ids=[record.id or ""])
            (again,) = read_trajectories([file.getvalue()], mdp)
            for one, two in zip(record.demonstration.arrays, again.demonstration.arrays, strict=True):
                if not np.array_equal(one, two, equal_nan=True):
                    raise AssertionError("what was read is not read back")

    def bouts(line: str | bytes) -> None:
        for bout in read_bouts(["\n", line], "log"):
            steps = [destination(node, a) for node in bout.nodes[:-1] for a in range(3)]
            if bout.nodes[0] != 0 or not set(bout.nodes[1:]) <= set(steps):
                raise AssertionError(f"a bout of {bout.nodes}")
            if not np.isfinite(np.array(bout.frames or (0,), float)).all():
                raise AssertionError(f"frames {bout.frames}")

    readers = {"trajectories": (trajectories, composed_trajectory), "bouts": (bouts, composed_bout)}
    found = {}
    for name, (reader, composed) in readers.items():
        for form, encode in (("text", str), ("bytes", lambda line: line.encode("utf-8", "surrogatepass"))):
            lines = fuzzed_lines(seed, composed)
            some = (encode(next(lines)) for _ in range(n))
            found[f"{name}, {form}"] = _fuzzed(some, reader, DemonstrationError, "log, line 2")
    return found


def fuzz_rows(seed: int, n: int) -> Tally:
    """Give ``n`` recordings of onions with a fuzzed row to their reader."""
    state = ",".join(["0.00"] * SIZE)
    lines = fuzzed_lines(seed, composed_row)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        states, actions = folder / "states_1.csv", folder / "actions_1.csv"
        actions.write_text("0,0,0\n0,0,0\n")

        def read(line: str) -> None:
            states.write_bytes(f"{state}\n{line}\n".encode("utf-8", "surrogatepass"))
            if not np.isfinite(np.asarray(read_onion_recordings(folder).observations)).all():
                raise AssertionError("a recording that is not finite")

        return _fuzzed((next(lines) for _ in range(n)), read, RecordingError, str(folder))


def _fuzzed(
    inputs: Iterable[Any], read: Callable[[Any], None], expected: type[Exception], place: str
) -> Tally:
    began, count, accepted, problems = time.perf_counter(), 0, 0, list[str]()
    for content in inputs:
        count += 1
        try:
            read(content)
            accepted += 1
        except Exception as error:
            message = str(error)
            good = (
                isinstance(error, expected)
                and message.startswith(place)
                and len(message) <= LONGEST_MESSAGE
                and message.isprintable()
            )
            if not good and len(problems) < 100:
                said = f"{type(error).__name__}: {message[:300]!a}"
                problems.append(f"input {count}: {said} for {content[:200]!a}")
    return Tally(count, accepted, tuple(problems), time.perf_counter() - began)


def largest_lines(limits: LineLimits = DEFAULT_LIMITS) -> dict[str, int]:
    """Measure the most memory allocated while reading lines of the limit's size, in bytes, by content."""
    size, mdp = limits.size, tiny_process()
    lines = {
        "steps within the limit": json.dumps([{"s": "bin", "a": 1, "score": 0.5}] * limits.steps),
        "empty lists": "[" + "[]," * (size // 3 - 1) + "[]]",
        "empty objects": "[" + "{}," * (size // 3 - 1) + "{}]",
        "small numbers": "[" + "9.5," * (size // 4 - 1) + "0]",
        "fields": "{" + ",".join(f'"{i:x}":0' for i in range(size // 10)) + "}",
        "one name": '["' + "x" * (size - 4) + '"]',
        "an unfinished name": '["' + "x" * (size - 2),
        "10 MB": "[" + "[]," * (10**7 // 3) + "[]]",
    }
    peaks = {}
    for name, line in lines.items():
        tracemalloc.start()
        with suppress(DemonstrationError):
            list(read_trajectories([line], mdp, "log", limits=limits))
        peaks[name] = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    return peaks


# -- archives -----------------------------------------------------------------------------------------


def plain_archive(**options: Any) -> bytes:
    """Make a valid archive of a small process with names and a view."""
    mdp = TabularMDP.from_successors(
        np.array([[[0, 1], [1, 2]]] * 3),
        np.full((3, 2, 2), 0.5),
        np.arange(12.0).reshape(3, 2, 2),
        states=("bin", "table", "größe"),
        actions=("grasp", "place"),
        **options,
    )
    with tempfile.TemporaryDirectory() as folder:
        save_mdp(Path(folder) / "m.npz", mdp, np.array([1.0, 0.5, 0.0]))
        return (Path(folder) / "m.npz").read_bytes()


def mutated_archives(seed: int, n: int) -> Iterator[bytes]:
    """Flip, delete, repeat or cut off bytes of valid archives; some of them have right checksums."""
    draws = random.Random(seed)
    base = plain_archive()
    arrays = _entries(base)
    for _ in range(n):
        if draws.random() < 0.5:
            yield _mutated(base, draws)
        else:
            # A mutated array in an archive that is itself whole.
            name = draws.choice(list(arrays))
            method = draws.choice([zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
            yield _archive({**arrays, name: _mutated(arrays[name], draws)}, method)


def _mutated(content: bytes, draws: random.Random) -> bytes:
    mutated = bytearray(content)
    for _ in range(1 + int(8 * draws.random() ** 3)):
        at, kind = draws.randrange(len(mutated) + 1), draws.random()
        if kind < 0.7 and at < len(mutated):
            mutated[at] = draws.choice([0, 1, 127, 255, mutated[at] ^ 1 << draws.randrange(8)])
        elif kind < 0.8:
            del mutated[at : at + draws.randrange(1, 64)]
        elif kind < 0.9:
            mutated[at:at] = mutated[at : at + draws.randrange(1, 64)]
        else:
            del mutated[max(at, 1) :]
    return bytes(mutated)


def _entries(content: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def _archive(entries: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", method) as archive:
        for name, content in entries.items():
            archive.writestr(name, content)
    return file.getvalue()


def _npy(array: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.lib.format.write_array(file, array, allow_pickle=True)
    return file.getvalue()


def _described(descr: str, shape: str, body: bytes = b"", fortran: str = "False") -> bytes:
    return _headed(f"{{'descr': {descr}, 'fortran_order': {fortran}, 'shape': {shape}, }}".encode(), body)


def _headed(header: bytes, body: bytes = b"", version: bytes = b"\x01\x00") -> bytes:
    length = struct.pack("<H" if version == b"\x01\x00" else "<I", len(header))
    return b"\x93NUMPY" + version + length + header + body


class _Raw(NamedTuple):
    """An entry of an archive as it is stored; ``size`` is what its inflated size is said to be."""

    name: bytes
    content: bytes
    size: int
    method: int = zipfile.ZIP_DEFLATED
    crc: int = 0


def _raw_archive(entries: Sequence[_Raw], repeated: int = 1) -> bytes:
    """Write an archive of entries as they are, its list ``repeated``."""
    body, listed = bytearray(), bytearray()
    for entry in entries:
        fields = (entry.method, 0, 0, entry.crc, len(entry.content), entry.size, len(entry.name), 0)
        offset = len(body)
        body += struct.pack("<4s5H3I2H", b"PK\x03\x04", 20, 0, *fields) + entry.name + entry.content
        listed += struct.pack("<4s6H3I5H2I", b"PK\x01\x02", 20, 20, 0, *fields, 0, 0, 0, 0, offset)
        listed += entry.name
    n = min(len(entries) * repeated, 0xFFFF)
    end = struct.pack("<4s4H2IH", b"PK\x05\x06", 0, 0, n, n, len(listed) * repeated, len(body), 0)
    return bytes(body + listed * repeated + end)


def _bomb(name: str, head: bytes, megabytes: int, others: dict[str, bytes], size: int | None = None) -> bytes:
    """Write an archive with an array that inflates to so many zeros behind its head, and claims ``size``."""
    squeeze = zlib.compressobj(9, zlib.DEFLATED, -15)
    first = squeeze.compress(head) + squeeze.flush(zlib.Z_FULL_FLUSH)
    # After a full flush blocks are independent of earlier ones, and can be repeated.
    block = squeeze.compress(bytes(2**20)) + squeeze.flush(zlib.Z_FULL_FLUSH)
    content = first + block * megabytes + squeeze.flush()
    size = len(head) + (megabytes << 20) if size is None else size
    entries = [_Raw(n.encode(), c, len(c), zipfile.ZIP_STORED, zlib.crc32(c)) for n, c in others.items()]
    return _raw_archive([*entries, _Raw(name.encode(), content, size)])


def crafted_archives() -> dict[str, bytes]:
    """Craft about two hundred archives that overwhelm or mislead a reader, by their fault."""
    base = plain_archive()
    arrays = _entries(base)
    rest = {name: content for name, content in arrays.items() if name != "features.npy"}
    found: dict[str, bytes] = {}

    def features(what: str, content: bytes) -> None:
        found[f"features: {what}"] = _archive({**rest, "features.npy": content})

    # Sizes.
    vast, small = _described("'<f8'", f"(3, 2, {2**25})"), _described("'<f8'", "(3, 2, 2)")
    found["a bomb of 1.5 GiB"] = _bomb("features.npy", vast, 1536, rest)
    found["a bomb of 3.9 GiB"] = _bomb("features.npy", small, 4000, rest)
    found["a bomb that claims to be small"] = _bomb("features.npy", small, 1024, rest, len(small) + 96)
    found["a vast array that claims to be small"] = _bomb("features.npy", vast, 1536, rest, len(vast) + 96)
    found["an unknown bomb"] = _bomb("reward.npy", _described("'<f8'", f"({2**28},)"), 2048, arrays)
    found["bombs in every array"] = _archive(
        {name: _npy(np.zeros(2**16)) for name in arrays}, zipfile.ZIP_DEFLATED
    )
    for shape in (
        f"({2**70},)",
        f"({2**32}, {2**32})",
        f"(0, {2**62})",
        "(0,)",
        f"({2**63 - 1},)",
        "(-1,)",
        "(3, 2, 3)",
        "(3, 2)",
        "(12,)",
        "()",
        "(3, 2, 2, 1, 1, 1, 1, 1)",
        "(" + "1, " * 40 + ")",
        "(" + "1, " * 900 + ")",
        "(1e3,)",
        "(True,)",
        "((3, 2, 2),)",
        "[3, 2, 2]",
        "(3L, 2L, 2L)",
        "None",
        "(" + "9" * 3000 + ",)",
    ):
        features(f"shape {shape[:40]}", _described("'<f8'", shape, bytes(96)))
    # Types.
    for descr in (
        "'|O'",
        "'<c16'",
        "'<c8'",
        "'|b1'",
        "'<U2'",
        "'|S8'",
        "'|V8'",
        "'<M8[s]'",
        "'<m8'",
        "'<f2'",
        "'<f4'",
        "'>f8'",
        "'<f16'",
        "'<i8'",
        "'<u8'",
        "'|i1'",
        "'<f3'",
        "'<q9'",
        "'<U0'",
        "'|V0'",
        f"'<U{2**31}'",
        "'<U999999999'",
        "'|S999999999'",
        "'f'",
        "'double'",
        "''",
        "'<'",
        "8",
        "None",
        "[('a', '<f8')]",
        "[('a', '|O')]",
        "{'a': 1}",
        "'<f8' + '<f8'",
        "'<f8' '<f8'",
        "b'<f8'",
        "'\\x3cf8'",
        "('<f8', (2,))",
    ):
        features(f"type {descr}", _described(descr, "(3, 2, 2)", bytes(96)))
    for fortran in ("True", "1", "None", "'True'", "[]"):
        features(f"order {fortran}", _described("'<f8'", "(3, 2, 2)", bytes(96), fortran))
    # Headers.
    good = b"{'descr': '<f8', 'fortran_order': False, 'shape': (3, 2, 2), }"
    for header in (
        b"",
        b"-" * 9000,
        b"-" * 4000,
        b"(" * 4000,
        b"[" * 60000,
        b"{" * 4096,
        b"\x00" * 100,
        b"\xff" * 100,
        b"__import__('os')",
        b"{}",
        good * 2,
        good + b"#" * 100,
        good + b" " * 4000,
        good + b" " * 60000,
        good.replace(b"'descr'", b"'Descr'"),
        good.replace(b"'shape'", b"'descr'"),
        good[:-1],
        b" " * 4000,
        good.replace(b", }", b", 'x': 1}"),
        good.replace(b": (", b":  \t ("),
        good.replace(b"'", b'"'),
        b"{'descr': '<f8'}",
        good.replace(b"False", b"F" * 4000),
        b"{" + b"'descr':'<f8'," * 250 + b"}",
        good.replace(b"(3, 2, 2)", b"(" + b" " * 3900 + b"3,2,2)"),
    ):
        for version in (b"\x01\x00", b"\x02\x00", b"\x03\x00"):
            features(f"header {version!r} {header[:40]!r} {len(header)}", _headed(header, bytes(96), version))
    for magic in (b"", b"\x93", b"\x93NUMPY", b"\x93NUMPY\x04\x00", b"\x93NUMPX\x01\x00", b"PK\x03\x04"):
        features(f"magic {magic!r}", magic + arrays["features.npy"][len(magic) :])
        features(f"only magic {magic!r}", magic)
    features("a header of 4 GB", b"\x93NUMPY\x02\x00\xff\xff\xff\xff" + bytes(96))
    features("one byte less", arrays["features.npy"][:-1])
    features("one byte more", arrays["features.npy"] + b"\0")
    # Contents.
    for name, array in {
        "successors": np.full((3, 2, 2), 2**62),
        "probabilities": np.full((3, 2, 2), np.nan),
        "features": np.full((3, 2, 2), np.inf),
        "initial": np.full(3, 1e308),
        "discount": np.array(np.nan),
        "available": np.zeros((3, 2), bool),
        "in_view": np.array([2.0, 0, 0]),
        "states": np.array(["a"] * 3),
        "actions": np.array(["grasp", "x" * 10**5]),
        "feature_names": np.array([["a", "b"]]),
    }.items():
        found[f"content of {name}"] = _archive({**arrays, f"{name}.npy": _npy(array)})
    found["objects"] = _archive({**arrays, "states.npy": _npy(np.array([{}, [], 1], object))})
    found["text beyond Unicode"] = _archive(
        {**arrays, "states.npy": _described("'<U1'", "(3,)", struct.pack("<3I", 65, 0x110000, 0xFFFFFFFF))}
    )
    found["half a character"] = _archive(
        {**arrays, "states.npy": _described("'<U1'", "(3,)", struct.pack("<3I", 65, 66, 0xD800))}
    )
    found["booleans of seven"] = _archive(
        {**arrays, "available.npy": _described("'|b1'", "(3, 2)", b"\x07" * 6)}
    )
    # The archive itself.
    for method in (zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA):
        found[f"method {method}"] = _archive(arrays, method)
    for offset, what, values in ((6, "flags", (1, 0x20, 0x40, 0x41)), (8, "method", (1, 9, 93, 98, 99))):
        for value in values:
            found[f"{what} {value}"] = _patched(base, offset, value)
    for name in (
        "reward.npy",
        "features",
        "features.NPY",
        "../features.npy",
        "/etc/passwd",
        "features.npy/",
        "x" * 60000,
        "é.npy",
        "\x1b[31m.npy",
        "features.npy.npy",
    ):
        found[f"name {name[:20]!r}"] = _archive({**arrays, name: b"\0" * 100})
    for name in arrays:
        found[f"without {name}"] = _archive({k: v for k, v in arrays.items() if k != name})
        found[f"empty {name}"] = _archive({**arrays, name: b""})
    file = io.BytesIO(base)
    with zipfile.ZipFile(file, "a") as archive, warnings.catch_warnings(action="ignore"):
        archive.writestr("features.npy", arrays["features.npy"])
    found["features twice"] = file.getvalue()
    found["nothing"] = b""
    found["an empty archive"] = _archive({})
    found["text"] = b"hello"
    found["an array alone"] = arrays["features.npy"]
    found["an archive in an archive"] = _archive({"features.npy": base})
    for entries in (1_000, 2_700, 22_000, 170_000):
        found[f"{entries} entries"] = _raw_archive([_Raw(b"a", b"x", 1, 0, zlib.crc32(b"x"))], entries)
    for cut in (1, 10, 22, 30, 100, len(base) // 2, len(base) - 10):
        found[f"cut by {cut}"] = base[:-cut]
        found[f"begun {cut} late"] = base[cut:]
    found["followed by junk"] = base + b"junk" * 1000
    found["led by junk"] = b"junk" * 1000 + base
    lie = b"PK\x06\x06" + b"\xff" * 52 + b"PK\x06\x07" + bytes(16)
    found["64-bit ends that lie"] = base[:-22] + lie + base[-22:]
    return found


def _patched(content: bytes, offset: int, value: int) -> bytes:
    """Set the 16-bit field at ``offset`` in every local header, and in every entry of the list."""
    patched = bytearray(content)
    for signature, extra in ((b"PK\x03\x04", 0), (b"PK\x01\x02", 2)):
        at = content.find(signature)
        while at >= 0:
            struct.pack_into("<H", patched, at + offset + extra, value)
            at = content.find(signature, at + 4)
    return bytes(patched)


def fuzz_archives(contents: Iterable[tuple[str, bytes]], limit: int = LIMIT) -> Tally:
    """Load each archive with a limit, beyond which reading must not allocate memory.

    Memory is the allocation of Python and NumPy while the file is read and the process is built.
    """
    began, count, accepted, peak, problems = time.perf_counter(), 0, 0, 0, list[str]()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "m.npz"
        for what, content in contents:
            count += 1
            path.write_bytes(content)
            tracemalloc.start()
            said = ""
            try:
                load_mdp(path, max_bytes=limit)
                accepted += 1
            except Exception as error:
                message = str(error)
                if not isinstance(error, StorageError) or not message.startswith(str(path)):
                    said = f"{type(error).__name__}: {message[:300]!a}"
                elif len(message) > LONGEST_MESSAGE or not message.isprintable():
                    said = f"its message has {len(message)} characters: {message[:300]!a}"
            used = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
            peak = max(peak, used)
            if used > limit:
                said = f"{said} {used} bytes were allocated, the limit is {limit}"
            if said and len(problems) < 100:
                problems.append(f"{what}: {said.strip()}")
    return Tally(count, accepted, tuple(problems), time.perf_counter() - began, peak)


# -- all of it ----------------------------------------------------------------------------------------


def main() -> None:
    """Run, publish, and fail if anything but the readers' own errors happened."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0] if __doc__ else None)
    parser.add_argument("--lines", type=int, default=1_000_000, help="lines in all")
    parser.add_argument("--archives", type=int, default=5_000, help="mutated archives")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    before = getrusage(RUSAGE_SELF).ru_maxrss
    tallies = fuzz_lines(options.seed, options.lines // 4)
    tallies["rows of recordings"] = fuzz_rows(options.seed, options.lines // 100)
    resident = getrusage(RUSAGE_SELF).ru_maxrss
    mutated = ((f"mutated {i}", c) for i, c in enumerate(mutated_archives(options.seed, options.archives)))
    tallies["mutated archives"] = fuzz_archives(mutated)
    tallies["crafted archives"] = fuzz_archives(crafted_archives().items())
    rows = [
        (
            name,
            t.inputs,
            t.read,
            len(t.problems),
            t.seconds,
            1e6 * t.seconds / max(t.inputs, 1),
            "" if t.peak < 0 else f"{t.peak / 2**20:.1f}",
        )
        for name, t in tallies.items()
    ]
    print_table(
        "Hostile input", ("reader", "inputs", "read", "problems", "seconds", "µs each", "peak (MiB)"), rows
    )
    peaks = largest_lines()
    print_table(
        f"Memory of reading one line (limit {DEFAULT_LIMITS.size} characters)",
        ("line", "peak (MiB)"),
        [(name, peak / 2**20) for name, peak in peaks.items()],
    )
    print(f"The process grew from {before / 1024:.0f} to {resident / 1024:.0f} MiB while reading lines.")
    problems = [f"{name}: {p}" for name, t in tallies.items() for p in t.problems]
    kinds = Counter(p.split(":")[0] for p in problems)
    for problem in problems[:40]:
        print(f"PROBLEM: {problem}")
    if not problems:
        print("Everything was read, or refused by the reader's own error that names file and line.")
    publish(
        "fuzz",
        {
            "seed": options.seed,
            "limit": LIMIT,
            "inputs": {name: t._asdict() for name, t in tallies.items()},
            "line_peaks": peaks,
            "resident_mib": [before / 1024, resident / 1024],
            "problems": dict(kinds),
        },
    )
    if problems:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
