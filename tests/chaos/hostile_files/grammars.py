"""Files made to do harm, from the grammar of their format: a function of a random number generator alone, each.

They come out as the name of an attack and the bytes. `FORGED` stands in texts: where it comes out at the start of a
line, or with the escape before it, a file has written into somebody's terminal.
"""

import io
import json
import pickle
import struct
import zipfile
import zlib
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import numpy as np
import pyarrow as pa
import pyarrow.feather

from factory.stages.scene_file import KEY, scene_digest, scene_header, scene_tensors
from tasks.render.splatting.formats import to_ply
from tests.factory.datasets.scenarionet.scenarionet_scenarios import nuplan, nuscenes, waymo
from tests.factory.stages.test_scene_file import scene

Rng: TypeAlias = np.random.Generator
Crafted: TypeAlias = tuple[str, bytes]  # what the attack is, the file
ESCAPE = "\x1b[2J"
FORGED = f"\n{ESCAPE}FORGED"
PRIME = 2**61 - 1  # integers are hashed modulo it
SIZES = (2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**62, 2**63 - 1)
MANY = (100, 10_000, 200_000)


def pick(rng: Rng, options: Sequence[Any]) -> Any:
    return options[int(rng.integers(len(options)))]


# Values


def shared(levels: int = 60, kind: type = tuple) -> Any:
    """3^levels values to whoever walks through them."""
    value: Any = kind()
    for _ in range(levels):
        value = {"a": value, "b": value} if kind is dict else kind((value, value, value))
    return value


def endless(kind: type = list) -> Any:
    value: Any = kind()
    value.append(value) if kind is list else value.update(a=value)
    return value


def nested(depth: int) -> Any:
    value: Any = 0
    for _ in range(depth):
        value = [value]
    return value


def colliding(n: int) -> dict[int, int]:
    """Every key has the hash 0; made without comparing them all here."""
    return dict.fromkeys((k * PRIME for k in range(n)), 0)


VALUES: dict[str, Callable[[Rng], Any]] = {
    "shared": lambda rng: shared(kind=pick(rng, (tuple, list, dict))),
    "holds itself": lambda rng: endless(pick(rng, (list, dict))),
    "nested": lambda rng: nested(int(pick(rng, (90, 150, 300)))),
    "huge integer": lambda rng: pick(rng, (1, -1)) * 10 ** int(pick(rng, (30, 308, 309, 400, 5000, 100_000))),
    "huge text": lambda rng: pick(rng, ("x", "\n", "é", "\ud800")) * int(pick(rng, MANY)),
    "huge float": lambda rng: pick(rng, (1e308, -1e308, 1e-320, float("nan"), float("inf"))),
    "forged text": lambda rng: pick(rng, (FORGED, f"a{FORGED}", "../../../etc/passwd", "/dev/zero", "\0", "")),
    "bytes": lambda rng: pick(rng, (b"", b"\xff" * int(pick(rng, MANY)))),
    "huge array": lambda rng: np.full(int(pick(rng, MANY)), pick(rng, (1e308, np.nan, 0.0))),
    "odd array": lambda rng: np.zeros(
        pick(rng, ((), (0,), (0, 3), (1, 1, 1, 1), (121, 0))), pick(rng, ("f8", "i1", "S5", "?"))
    ),
    "text array": lambda rng: np.array([FORGED] * int(pick(rng, (1, 121)))),
    "many keys": lambda rng: {f"{k}{FORGED}": k for k in range(int(pick(rng, MANY[:2])))},
    "odd keys": lambda rng: {pick(rng, (None, True, 1.5, (), (FORGED,), -1, 10**4999, float("nan"))): {}},
    "colliding keys": lambda rng: colliding(int(pick(rng, (3, 300, 3000)))),
}


def value(rng: Rng) -> tuple[str, Any]:
    name = pick(rng, list(VALUES))
    return name, VALUES[name](rng)


def planted(tree: Any, rng: Rng, what: Any, chance: float = 0.8) -> Any:
    """The tree with a value at a place of it; containers on the way are copies."""
    if isinstance(tree, dict) and tree and rng.random() < chance:
        key = pick(rng, list(tree))
        if rng.random() < 0.1 and isinstance(what, str | int | float):
            return {**tree, what: tree[key]}
        return {**tree, key: planted(tree[key], rng, what, chance)}
    if isinstance(tree, list | tuple) and tree and rng.random() < chance:
        k = int(rng.integers(len(tree)))
        return type(tree)([*tree[:k], planted(tree[k], rng, what, chance), *tree[k + 1 :]])
    return what


# Pickles: whole logs with a value in them, and programs


def long4(n: int) -> bytes:
    raw = n.to_bytes(n.bit_length() // 8 + 1, "little", signed=True)
    return b"\x8b" + len(raw).to_bytes(4, "little") + raw


def colliding_keys(n: int, how: str) -> bytes:
    keys = [long4(k * PRIME) for k in range(1, n + 1)]
    match how:
        case "dict":
            return b"}(" + b"".join(key + b"N" for key in keys) + b"u"
        case "set":
            return b"\x8f(" + b"".join(keys) + b"\x90"
        case "frozenset":
            return b"(" + b"".join(keys) + b"\x91"
        case "set of a list":
            return b"cbuiltins\nset\n(](" + b"".join(keys) + b"etR"
        case _:
            return b"}(" + b"".join(key + b"\x85N" for key in keys) + b"u"  # of tuples of one


def array(shape: Sequence[int], kind: bytes, raw: bytes = b"") -> bytes:
    """numpy's own program for an array."""
    start = b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(K\x00tC\x01btR(K\x01("
    sizes = b"".join(map(long4, shape))
    spec = (
        b"tcnumpy\ndtype\n(X" + len(kind).to_bytes(4, "little") + kind + b"I00\nI01\ntR(K\x03U\x01<NNNJ\xff\xff\xff\xff"
    )
    return start + sizes + spec + b"J\xff\xff\xff\xffK\x00tbI00\nB" + len(raw).to_bytes(4, "little") + raw + b"tb"


def program(rng: Rng) -> Crafted:
    """A pickle that is no value of Python's, or one that Python would not write."""
    n, size = int(pick(rng, MANY)), int(pick(rng, SIZES))
    how = pick(rng, ("dict", "set", "frozenset", "set of a list", "tuples"))
    names = (b"os\nsystem", b"builtins\neval", b"builtins\ngetattr", b"copyreg\n_reconstructor", FORGED.encode())
    bodies: dict[str, bytes] = {
        "deep": b"]" * n + b"a" * (n - 1),
        "deep marks": b"(" * n + b"t" * n,
        "memo index": b"Nr" + struct.pack("<I", size & 0xFFFFFFFF),
        "length of an integer": b"\x8b" + struct.pack("<i", min(size, 2**31 - 1)) + b"\1" * 10,
        "length of a text": b"\x8d" + struct.pack("<Q", size) + b"x",
        "length of bytes": b"\x8e" + struct.pack("<Q", size),
        "length of a frame": b"\x95" + struct.pack("<Q", size) + b"N",
        "digits": b"I" + b"9" * n + b"\n",
        "digits of a long": b"L" + b"9" * n + b"L\n",
        "a name": b"c" + pick(rng, names) + b"\n(U\x04true" + pick(rng, (b"tR", b"t\x81", b"t}\x92")),
        "an instance": b"(U\x04true" + b"i" + pick(rng, names) + b"\n",
        "a persistent id": b"P" + FORGED[1:].encode() + b"\n",
        "an extension": b"\x82\x01",
        "a shape": array((size,), pick(rng, (b"f8", b"S9", b"?", b"u1"))),
        "shapes that multiply to 0": array((size, 0, size), b"f8"),
        "a kind": array((1,), pick(rng, (b"O", b"V1000000000", b"(1000000,)f8", b"f8,O", b"U99999", FORGED.encode()))),
        "copies of a text": b"]X" + struct.pack("<I", n) + b"x" * n + b"q\1(" + b"h\1" * 5000 + b"e",
        "copies of an array": b"]" + array((n,), b"u1", b"\0" * n) + b"q\1a(" + b"h\1" * 5000 + b"e",
        "tuples of a tuple": b"(" + b"K\1" * n + b"tq\1" + b"cbuiltins\nlist\n(h\1tR" * 1000,
        "colliding keys": colliding_keys(int(pick(rng, (1000, 30_000))), how),
        "nothing": pick(rng, (b"", b"0", b"(((", b"\xff", b"u", b"}Nb")),
    }
    name = pick(rng, list(bodies))
    return f"program: {name}", pick(rng, (b"\x80\x02", b"\x80\x04", b"")) + bodies[name] + pick(rng, (b".", b".", b""))


def dumped(tree: Any, rng: Rng) -> bytes:
    return pickle.dumps(tree, int(rng.integers(2, 6)))


def scenario(rng: Rng) -> Crafted:
    if rng.random() < 0.35:
        return program(rng)
    name, what = value(rng)
    made = pick(rng, (nuscenes, waymo, nuplan))()
    return f"scenario: {name}", dumped(planted(made, rng, what), rng)


# numpy's arrays and archives


def npy_header(text: str, version: int = 1, length: int | None = None) -> bytes:
    packed = struct.pack(
        "<H" if version == 1 else "<I",
        (len(text) if length is None else length) & (0xFFFF if version == 1 else 0xFFFFFFFF),
    )
    return b"\x93NUMPY" + bytes([version, 0]) + packed + text.encode("latin1" if version < 3 else "utf-8")


def npy(rng: Rng) -> Crafted:
    size, n = int(pick(rng, SIZES)), int(pick(rng, (100, 9_000)))
    kinds = (
        "'<f8'",
        "'|O'",
        "'<U99999999'",
        f"'V{size}'",
        "[('a','<f8',(99999,))]",
        repr(FORGED),
        "'<M8[as]'",
        "'|S1'",
    )
    shapes = (f"({size},)", f"({size},0,{size})", "(-1,)", "(9,40,3)", f"(9,40,{'9' * n})", f"({'1,' * n})", "(1e308,)")
    texts = {
        "shape": f"{{'descr': '<f8', 'fortran_order': False, 'shape': {pick(rng, shapes)}, }}\n",
        "kind": f"{{'descr': {pick(rng, kinds)}, 'fortran_order': True, 'shape': {pick(rng, shapes)}, }}\n",
        "deep": "(" * n + ")" * n,
        "signs": "-" * n + "1",
        "keys": "{" + ", ".join(f"'{k}': {k}" for k in range(n // 20)) + "}",
        "an expression": "__import__('os').system('true')",
    }
    name = pick(rng, list(texts))
    length = pick(rng, (None, None, None, size))
    return f"npy: {name}", npy_header(texts[name], int(rng.integers(1, 4)), length) + bytes(int(pick(rng, (0, 8640))))


def deflated(head: bytes, n_bytes: int, wbits: int) -> bytes:
    """The head and zeros, which are packed once and repeated; a checksum at its end is wrong."""
    packer = zlib.compressobj(9, zlib.DEFLATED, wbits)
    start = packer.compress(head) + packer.flush(zlib.Z_FULL_FLUSH)
    million = packer.compress(bytes(10**6)) + packer.flush(zlib.Z_FULL_FLUSH)
    return start + million * (n_bytes // 10**6) + packer.flush()


def npz(rng: Rng, names: Sequence[str] = ("trajectories", "digest", "tree")) -> Crafted:
    sink, what = io.BytesIO(), pick(rng, ("bomb", "members", "doubled", "paths", "headers"))
    if what == "bomb":
        n = 960 * int(pick(rng, (10**5, 2 * 10**6)))
        head = npy_header(f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({n // 960},40,3), }}\n")
        body = deflated(head, n, -15)
        name = b"trajectories.npy"
        told = struct.pack("<HHHHHIII", 20, 0, 8, 0, 0, 0, len(body), n + len(head)) + struct.pack("<HH", len(name), 0)
        entry = b"PK\1\2\x14\0" + told + struct.pack("<HHHII", 0, 0, 0, 0, 0) + name
        end = struct.pack("<HHHHIIH", 0, 0, 1, 1, len(entry), 30 + len(name) + len(body), 0)
        return "npz: bomb", b"PK\3\4" + told + name + body + entry + b"PK\5\6" + end
    with zipfile.ZipFile(sink, "w", zipfile.ZIP_DEFLATED) as packed:
        for name in names if what != "members" else [f"{FORGED}{k}" for k in range(5_000)]:
            good = npy_header("{'descr': '|u1', 'fortran_order': False, 'shape': (8,), }\n") + bytes(8)
            packed.writestr(
                f"../../{name}.npy" if what == "paths" else f"{name}.npy", npy(rng)[1] if what == "headers" else good
            )
        if what == "doubled":
            packed.writestr(f"{names[0]}.npy", npy(rng)[1])
    return f"npz: {what}", sink.getvalue()


def array_file(rng: Rng) -> Crafted:
    return npz(rng) if rng.random() < 0.2 else npy(rng)


# Arrow


def columns_of(good: pa.Table, rng: Rng) -> tuple[str, pa.Table]:
    """A table like a good one, where a column is another, or all are longer."""
    rows, name = max(good.num_rows, 1), pick(rng, good.column_names)
    at = good.column_names.index(name)
    n = int(pick(rng, (10**6, 10**7)))
    kind = good.schema.field(name).type
    extremes = {"f": (1e308, -1e308, np.nan), "i": (2**63 - 1, -(2**63), 2**31)}
    letter = "f" if pa.types.is_floating(kind) else "i"
    columns: dict[str, Callable[[], pa.Array]] = {
        "extremes": lambda: pa.array([pick(rng, extremes[letter])] * rows),
        "forged texts": lambda: pa.array([FORGED] * rows),
        "nested": lambda: pa.array([nested(60)] * rows),
        "long texts": lambda: pa.DictionaryArray.from_arrays(np.zeros(rows, np.int32), ["x" * n]),
        "nulls": lambda: pa.nulls(rows),
        "runs": lambda: pa.RunEndEncodedArray.from_arrays(pa.array([rows], pa.int64()), pa.array([1e308])),
        "wide": lambda: pa.array([b"\0" * 10_000] * rows, pa.binary(10_000)),
        "big decimals": lambda: pa.array([None] * rows, pa.decimal256(76, -100)),
        "odd stamps": lambda: pa.array([2**62] * rows, pa.timestamp("ns")),
    }
    what = pick(rng, [*columns, "rows", "rows of nothing", "many columns", "names"])
    if what == "rows":
        long = {c: pa.nulls(n, good.schema.field(c).type) for c in good.column_names}
        return what, pa.table(long).replace_schema_metadata(good.schema.metadata)
    if what == "rows of nothing":
        return what, pa.table({c: pa.nulls(int(pick(rng, SIZES))) for c in [name]})
    if what == "many columns":
        return what, pa.table({f"{k}": pa.nulls(rows) for k in range(20_000)})
    if what == "names":
        return what, good.rename_columns([f"{FORGED}{c}" if c == name else c for c in good.column_names])
    return what, good.set_column(at, name, columns[what]())


def arrow(good: pa.Table, rng: Rng) -> Crafted:
    if rng.random() < 0.2:
        size = int(pick(rng, SIZES))
        return "arrow: length of its footer", b"ARROW1\0\0" + bytes(64) + struct.pack(
            "<I", size & 0x7FFFFFFF
        ) + b"ARROW1"
    what, table = columns_of(good, rng)
    sink = io.BytesIO()
    options = pa.ipc.IpcWriteOptions(compression=pick(rng, ("zstd", "lz4")))
    with pa.ipc.new_file(sink, table.schema, options=options) as writer:
        writer.write_table(table)
    return f"arrow: {what}", sink.getvalue()


# JSON, YAML


def json_text(good: Any, rng: Rng) -> Crafted:
    """A text with a value in it that JSON can say, or a text of signs."""
    n = int(pick(rng, MANY))
    words = (
        "1e308",
        "-1e999",
        "NaN",
        "9" * n,
        "[" * n,
        "[" * n + "]" * n,
        '{"a":' * n,
        json.dumps(FORGED),
        '"' + "x" * n + '"',
    )
    what = int(rng.integers(len(words)))
    mark = "@@here@@"
    text = json.dumps(planted(good, rng, mark, 0.9)) if rng.random() < 0.8 else f'"{mark}"'
    names = ("1e308", "1e999", "NaN", "digits", "open", "deep", "objects", "forged", "long text")
    return f"json: {names[what]}", text.replace(f'"{mark}"', words[what], 1).encode()


YAML_KEYS = (
    "tokens",
    "log_names",
    "max_scenes",
    "num_history_frames",
    "all_mapping",
    "_target_",
    FORGED[1:],
    "scene_filter",
)


def yaml_text(rng: Rng) -> Crafted:
    n = int(pick(rng, (60, 3_000, 60_000)))
    kind = pick(rng, ("[*a{0}, *a{0}, *a{0}]", "{{x: *a{0}, y: *a{0}}}"))
    aliases = ["&a0 [x]", *(f"&a{k} {kind.format(k - 1)}" for k in range(1, 60))]
    bodies = {
        "aliases": "\n".join(f"  - {line}" for line in aliases),
        "itself": " &a [*a, *a]",
        "itself as a key": " &a {? *a : 1}",
        "merges": " &a {<<: [*a, *a]}",
        "merges of merges": "\n  - &a0 {x: 1}\n"
        + "".join(f"  - &a{k} {{<<: [*a{k - 1}, *a{k - 1}, *a{k - 1}]}}\n" for k in range(1, 40)),
        "digits": " " + pick(rng, ("", "-", "0x", "0b", "0")) + "1" * n,
        "sixties": " " + ":".join(["59"] * n),
        "deep": " " + "[" * n,
        "deep blocks": " " + "- " * min(n, 3000) + "1",
        "a tag": " !!python/object/apply:os.system [true]",
        "bytes": " !!binary " + "AAAA" * n,
        "a date": " 9999-99-99T99:99:99Z",
        "colliding keys": "\n" + "".join(f"  {k * PRIME}: 0\n" for k in range(1, n)),
        "long text": " " + pick(rng, ("x", "é")) * n,
        "forged": " " + json.dumps([FORGED]),
        "many keys": "\n" + "".join(f"k{k}: 1\n" for k in range(n)),
        "1e308": " [1.0e+308, .inf, .nan]",
    }
    name = pick(rng, list(bodies))
    return f"yaml: {name}", f"{json.dumps(pick(rng, YAML_KEYS))}:{bodies[name]}\n".encode()


# Scenes: ply, spz, safetensors


def ply(rng: Rng) -> Crafted:
    good, size, n = to_ply(scene().background), int(pick(rng, SIZES)), int(pick(rng, (1000, 20_000)))
    head, _, body = good.partition(b"end_header\n")
    lines = head.decode().splitlines()
    at = next(k for k, line in enumerate(lines) if line.startswith("element vertex"))
    heads = {
        "count": [*lines[:at], f"element vertex {pick(rng, (size, '9' * n, '-1', '1e308'))}", *lines[at + 1 :]],
        "properties": [*lines, *(f"property float p{k}" for k in range(n))],
        "doubled": [*lines, *lines[at + 1 :]],
        "lists": [*lines[: at + 1], f"property list {pick(rng, ('uint', 'char'))} float x", *lines[at + 1 :]],
        "elements": [*lines[:1], *(f"element e{k} {size}" for k in range(n)), *lines[1:]],
        "a kind": [line.replace("float", pick(rng, ("double", FORGED[1:], "uchar", "f8" * 9))) for line in lines],
        "a format": [line.replace("binary_little_endian", pick(rng, ("ascii", FORGED[1:]))) for line in lines],
        "a comment": [lines[0], "comment " + "x" * n * 100, *lines[1:]],
    }
    name = pick(rng, [*heads, "values"])
    if name == "values":
        return "ply: values", head + b"end_header\n" + struct.pack("<f", pick(rng, (3e38, np.nan, np.inf, 0.0))) * (
            len(body) // 4
        )
    return f"ply: {name}", "\n".join([*heads[name], "end_header", ""]).encode() + body


def spz(rng: Rng) -> Crafted:
    count, version, degree = (
        int(pick(rng, (0, 1, 10**6, 10**7, 2**32 - 1))),
        int(rng.integers(0, 6)),
        int(pick(rng, (0, 3, 4, 255))),
    )
    head = struct.pack(
        "<IIIBBBB", 0x5053474E, version, count, degree, int(pick(rng, (0, 12, 255))), int(pick(rng, (0, 1, 255))), 0
    )
    if rng.random() < 0.5:
        size = int(pick(rng, (10**6, 2 * 10**8, 6 * 10**8)))
        return "spz: gzip", deflated(head, size, 31)
    streams = int(pick(rng, (0, 5, 6, 255)))
    sizes = [count * each for each in (9, 1, 3, 3, 4, 45)]
    frames = [pa.compress(bytes(min(size, 10**7)), codec="zstd", asbytes=True) for size in sizes[:streams]]
    lies = pick(rng, (None, 2**62, 2**64 - 1))
    table = b"".join(struct.pack("<QQ", lies or len(frame), size) for frame, size in zip(frames, sizes))
    head = head[:8] + head[8:15] + bytes([streams]) + struct.pack("<I", int(pick(rng, (32, 0, 2**32 - 1)))) + bytes(12)
    return "spz: zstd", head + table + b"".join(frames)


def safetensors(rng: Rng) -> Crafted:
    """With its digest where it is a scene: who writes a file knows how to compute it."""
    from safetensors.numpy import save

    good, size, n = scene(), int(pick(rng, SIZES)), int(pick(rng, MANY))
    tensors, described = dict(scene_tensors(good)), scene_header(good)
    raw = {
        "length": struct.pack("<Q", size) + b"{}",
        "shape": {"a": {"dtype": "F32", "shape": [size, size], "data_offsets": [0, 4]}},
        "no bytes": {"a": {"dtype": "F32", "shape": [0, size], "data_offsets": [0, 0]}},
        "offsets": {"a": {"dtype": "F32", "shape": [1], "data_offsets": [size, 0]}},
        "overlap": {k: {"dtype": "U8", "shape": [4], "data_offsets": [0, 4]} for k in "ab"},
        "a kind": {"a": {"dtype": pick(rng, ("F8_E4M3", "BF16", FORGED)), "shape": [4], "data_offsets": [0, 4]}},
        "many": {f"{FORGED}{k}": {"dtype": "U8", "shape": [0], "data_offsets": [0, 0]} for k in range(20_000)},
        "metadata": {"__metadata__": {KEY: pick(rng, ("[" * n, "9" * n, "NaN", json.dumps(FORGED), "{}" + " " * n))}},
    }
    name = pick(rng, [*raw, "described", "described", "tensors"])
    if name in raw:
        if isinstance(raw[name], bytes):
            return f"safetensors: {name}", raw[name]
        text = json.dumps(raw[name]).encode()
        return f"safetensors: {name}", struct.pack("<Q", len(text)) + text + bytes(4)
    if name == "tensors":
        key = pick(rng, list(tensors))
        kinds = (
            np.zeros((0, 3)),
            np.full(tensors[key].shape, np.nan, np.float32),
            np.zeros(n),
            tensors[key].astype("i8"),
        )
        tensors[key] = np.ascontiguousarray(pick(rng, kinds))
    else:
        what = pick(
            rng, ("x" * n, FORGED, 1e308, 10**400, None, -1, [[]] * n, list(range(n)), {FORGED: 1}, nested(90), True)
        )
        described = planted(described, rng, what, 0.9)
        if not isinstance(described, dict):
            described = {"version": described}
    try:
        header = described | {"digest": scene_digest(tensors, described), "kept_as": "x"}
    except (ValueError, TypeError, RecursionError):  # no JSON of ours, as NaN is none
        header = described | {"digest": "0" * 64, "kept_as": "x"}
    return f"safetensors: {name}", save(tensors, {KEY: json.dumps(header)})


# Checkpoints


def checkpoint(rng: Rng) -> Crafted:
    """What torch's own loader takes for tensors, and what it should not."""
    import torch

    if rng.random() < 0.3:
        name, body = program(rng)
        sink = io.BytesIO()
        with zipfile.ZipFile(sink, "w", pick(rng, (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as packed:
            packed.writestr("archive/data.pkl", body)
            packed.writestr("archive/version", "3\n")
            packed.writestr("archive/byteorder", pick(rng, ("little", "big", FORGED)))
            packed.writestr(
                pick(rng, ("archive/data/0", "../../data/0", "archive/data.pkl")), bytes(int(pick(rng, MANY)))
            )
        return f"checkpoint: {name}", sink.getvalue()
    size, n = int(pick(rng, (10**5, 2**40, 2**62))), int(pick(rng, MANY))
    one = torch.zeros(1)
    tensors: dict[str, Callable[[], Any]] = {
        "strides of 0": lambda: one.expand(int(pick(rng, (10**6, 10**9, 10**11)))),
        "sparse": lambda: torch.sparse_coo_tensor(torch.zeros((1, 1), dtype=torch.int64), one, (size,)),
        "sparse rows": lambda: torch.sparse_csr_tensor(torch.tensor([0, 1]), torch.tensor([0]), one, (1, size)),
        "meta": lambda: torch.empty(size, device="meta"),
        "quantised": lambda: torch.quantize_per_tensor(one, 1e-30, 0, torch.qint8),
        "complex": lambda: torch.zeros(3, dtype=torch.complex64),
        "half": lambda: torch.zeros(n, dtype=pick(rng, (torch.bfloat16, torch.float8_e4m3fn, torch.float16))),
        "nan": lambda: torch.full((n, 3), pick(rng, (torch.nan, torch.inf, 3e38))),
        "empty": lambda: torch.empty((0, size)),
        "a parameter": lambda: torch.nn.Parameter(one.expand(10**9)),
        "nested": lambda: torch.nested.nested_tensor([one, torch.zeros(2)]),
        "value": lambda: VALUES[
            (chosen := pick(rng, ["shared", "holds itself", "huge integer", "huge text", "odd keys"]))
        ](rng),
    }
    name = pick(rng, list(tensors))
    keys = ("means", "quats", "scales", "opacities", "features_dc", "features_rest")
    gauss = {f"_model.gauss_params.{k}": torch.zeros(2, w) for k, w in zip(keys, (3, 4, 3, 1, 3, 0))}
    public = {
        f"agent._transfuser_model.{k}": torch.zeros(2) for k in ("_status_encoding.weight", "_keyval_embedding.weight")
    }
    inside: dict[str, Any] = pick(rng, (gauss, public, {}))
    key = pick(rng, [*inside, FORGED, "_model.gauss_params.means"])
    inside = {**inside, key: tensors[name]()}
    sink = io.BytesIO()
    tree = pick(rng, (inside, {"state_dict": inside}, {"pipeline": inside}, {"pipeline": inside, "step": 10**4000}))
    torch.save(tree, sink, _use_new_zipfile_serialization=bool(rng.random() < 0.8 or name in ("nested", "sparse rows")))
    return f"checkpoint: {name}", sink.getvalue()


# Pictures


def chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png(rng: Rng) -> Crafted:
    width, height = (int(pick(rng, (0, 1, 64, 8192, 65_535, 2**31 - 1, 2**32 - 1))) for _ in range(2))
    depth, colour, interlaced = (
        int(pick(rng, (1, 8, 16, 3))),
        int(pick(rng, (0, 2, 3, 6, 7))),
        int(pick(rng, (0, 1, 9))),
    )
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, interlaced))
    bomb = deflated(b"", int(pick(rng, (0, 10**6, 10**9))), 15)
    extra = {
        "plain": b"",
        "second header": chunk(b"IHDR", struct.pack(">IIBBBBB", 30_000, 30_000, 8, 2, 0, 0, 0)),
        "profile": chunk(b"iCCP", b"a\0\0" + bomb),
        "text": chunk(b"zTXt", b"a\0\0" + bomb) * int(pick(rng, (1, 20))),
        "palette": chunk(b"PLTE", b"\0" * 3 * 300),
        "animated": chunk(b"acTL", struct.pack(">II", 2**31 - 1, 0)),
        "length": struct.pack(">I", 2**31 - 1) + b"tEXt",
        "many": chunk(b"tEXt", b"a\0b") * 100_000,
        "exif": chunk(b"eXIf", b"II*\0" + struct.pack("<I", 2**32 - 1)),
    }
    name = pick(rng, list(extra))
    return f"png: {name}", b"\x89PNG\r\n\x1a\n" + head + extra[name] + chunk(b"IDAT", bomb) + chunk(b"IEND", b"")


def segment(marker: int, body: bytes) -> bytes:
    return bytes([0xFF, marker]) + struct.pack(">H", len(body) + 2) + body


def jpeg(rng: Rng) -> Crafted:
    """Headers, and pictures of many scans of nothing."""
    width, height = (int(pick(rng, (0, 1, 64, 4096, 8192, 65_535))) for _ in range(2))
    parts = int(pick(rng, (1, 3, 4)))
    sizes = bytes(f for k in range(parts) for f in (k + 1, pick(rng, (0x11, 0x22, 0x44)), 0))
    frame = lambda w, h: struct.pack(">BHHB", 8, h, w, parts) + sizes  # noqa: E731
    tables = segment(0xDB, b"\0" + b"\1" * 64) + b"".join(segment(0xC4, bytes([k, 1, *[0] * 15, 0])) for k in (0, 0x10))
    scan = segment(0xDA, bytes([parts, *(f for k in range(parts) for f in (k + 1, 0)), 0, 63, 0])) + b"\0" * 64
    runs = segment(0xC4, bytes([0x10, 1, *[0] * 15, 0xE0]))  # 16,384 blocks without a coefficient in 15 bits
    idle = runs + (segment(0xDA, bytes([1, 1, 0, 1, 63, 0])) + b"\x7f" * 4) * int(pick(rng, (20, 400)))
    first = segment(0xDA, bytes([parts, *(f for k in range(parts) for f in (k + 1, 0)), 0, 0, 1])) + b"\0" * 64
    shapes = {
        "sequential": segment(0xC0, frame(width, height)) + tables + scan,
        "two frames": segment(0xC0, frame(64, 36)) + segment(0xC2, frame(width, height)) + tables + scan,
        "scans": segment(0xC2, frame(8192, 8192)) + tables + first + idle,
        "scans of a small one": segment(0xC2, frame(1920, 1200)) + tables + first + idle * 4,
        "lossless": segment(0xC3, frame(width, height)) + tables + scan,
        "arithmetic": segment(0xC9, frame(width, height)) + tables + scan,
        "lines told later": segment(0xC0, frame(width, 0)) + tables + scan + segment(0xDC, b"\xff\xff"),
        "exif": segment(0xE1, b"Exif\0\0II*\0" + struct.pack("<I", 2**32 - 1))
        + segment(0xC0, frame(width, height))
        + tables
        + scan,
        "thumbnail": segment(0xE1, segment(0xC0, frame(64, 36))) + segment(0xC0, frame(width, height)) + tables + scan,
        "many segments": segment(0xFE, b"x") * 100_000 + segment(0xC0, frame(width, height)) + tables + scan,
        "filler": b"\xff" * 10**6 + segment(0xC0, frame(width, height)) + tables + scan,
    }
    name = pick(rng, list(shapes))
    return f"jpeg: {name}", b"\xff\xd8" + shapes[name] + b"\xff\xd9"


def other_picture(rng: Rng) -> Crafted:
    side = int(pick(rng, SIZES)) & 0x7FFFFFFF
    heads = {
        "bmp": b"BM" + struct.pack("<IHHIIiiHHIIiiII", 54, 0, 0, 54, 40, side, side, 1, 24, 0, 0, 0, 0, 0, 0),
        "gif": b"GIF89a" + b"\xff" * 20,
        "tiff": b"II*\0" + struct.pack("<I", 2**32 - 1),
        "webp": b"RIFF" + struct.pack("<I", side) + b"WEBPVP8L" + b"\xff" * 20,
        "pfm": b"PF\n%d %d\n-1.0\n" % (side, side),
        "hdr": b"#?RADIANCE\n\n-Y %d +X %d\n" % (side, side),
        "exr": b"v/1\x01" + b"\xff" * 50,
        "pnm": b"P6 %d %d 255\n" % (side, side),
        "jp2": b"\0\0\0\x0cjP  \r\n\x87\n" + b"\xff" * 60,
        "avif": b"\0\0\0\x1cftypavif" + b"\xff" * 60,
    }
    name = pick(rng, list(heads))
    return f"picture: {name}", heads[name]


def picture(rng: Rng) -> Crafted:
    return pick(rng, (png, jpeg, jpeg, other_picture))(rng)  # type: ignore[no-any-return]


# MCAP


def record(opcode: int, body: bytes, length: int | None = None) -> bytes:
    return bytes([opcode]) + struct.pack("<Q", len(body) if length is None else length) + body


def zstd_zeros(n_bytes: int) -> bytes:
    """One frame of blocks that each repeat a byte (RFC 8878); of no told size."""
    block = lambda last: struct.pack("<I", last | 1 << 1 | 128 * 1024 << 3)[:3] + b"\0"  # noqa: E731
    return b"\x28\xb5\x2f\xfd\x00\x58" + block(0) * (n_bytes // 2**17) + block(1)


def mcap(rng: Rng) -> Crafted:
    size, kind = int(pick(rng, SIZES)), pick(rng, ("zstd", "lz4", "", FORGED))
    zeros = int(pick(rng, (10**6, 15 * 10**8)))
    squeezed = zstd_zeros(zeros) if kind != "lz4" else pa.compress(bytes(10**7), codec="lz4", asbytes=True)
    text = lambda word: struct.pack("<I", len(word)) + word.encode()  # noqa: E731
    head = record(1, text("") + text("x"))
    a_chunk = (
        struct.pack("<QQQI", 0, 1, pick(rng, (zeros, size)), 0)
        + text(kind)
        + struct.pack("<Q", len(squeezed))
        + squeezed
    )
    bodies = {
        "chunk bomb": record(6, a_chunk) * int(pick(rng, (1, 4))),
        "length": record(6, b"", size),
        "length of a text": record(3, struct.pack("<HI", 1, size & 0xFFFFFFFF)),
        "statistics": record(11, struct.pack("<QHIIII", 2**64 - 1, 1, 1, 1, 1, 1) + bytes(20)),
        "many": record(15, struct.pack("<I", 0)) * 100_000,
        "opcodes": record(int(rng.integers(16, 256)), b"x" * 100),
    }
    name = pick(rng, list(bodies))
    footer = record(2, struct.pack("<QQI", pick(rng, (0, 30, size)), pick(rng, (0, size)), 0))
    return f"mcap: {name}", b"\x89MCAP0\r\n" + head + bodies[name] + footer + b"\x89MCAP0\r\n"


# Delta tables: a commit


def with_stats(add: dict[str, Any], rng: Rng, n: int) -> dict[str, Any]:
    stats = pick(
        rng,
        (
            "x" * n,
            "[" * n,
            '{"numRecords": 1e308}',
            f'{{"numRecords": {2**63 - 1}, "minValues": {{"attempt_id": "{"z" * n}"}}}}',
        ),
    )
    return add | {"stats": stats}


def commit(good: Sequence[dict[str, Any]], rng: Rng) -> Crafted:
    """A log's first commit: actions like a good one's with lies among them."""
    n, size = int(pick(rng, MANY)), int(pick(rng, SIZES))
    lies: dict[str, Callable[[dict[str, Any]], Any]] = {
        "path": lambda add: (
            add
            | {
                "path": pick(
                    rng,
                    (
                        "../../../../etc/passwd",
                        "/etc/passwd",
                        "file:///etc/passwd",
                        "s3://x/y",
                        "%2e%2e/x",
                        FORGED,
                        "",
                        "x" * n,
                    ),
                )
            }
        ),
        "statistics": lambda add: with_stats(add, rng, n),
        "size": lambda add: add | {"size": pick(rng, (size, -1, 0))},
        "partition": lambda add: (
            add | {"partitionValues": {FORGED: FORGED, **{f"{k}": "x" for k in range(min(n, 9999))}}}
        ),
        "vector": lambda add: (
            add
            | {
                "deletionVector": {
                    "storageType": "p",
                    "pathOrInlineDv": "/etc/passwd",
                    "sizeInBytes": size & 0x7FFFFFFF,
                    "cardinality": size,
                }
            }
        ),
        "value": lambda add: planted(add, rng, pick(rng, (1e308, None, [], FORGED, -1, True)), 0.95),
    }
    what = pick(rng, [*lies, "schema", "protocol", "many", "text", "properties"])
    actions = [dict(action) for action in good]
    for action in actions:
        if "add" in action and what in lies:
            action["add"] = lies[what](action["add"])
        if "protocol" in action and what == "protocol":
            action["protocol"] = {
                "minReaderVersion": size & 0x7FFFFFFF,
                "minWriterVersion": 2,
                "readerFeatures": [FORGED],
            }
        if "metaData" in action and what == "schema":
            schema = pick(
                rng,
                (
                    "[" * n,
                    "",
                    '{"type":"struct","fields":' * min(n, 9999),
                    json.dumps({"type": "struct", "fields": []}),
                ),
            )
            action["metaData"] = action["metaData"] | {"schemaString": schema}
        if "metaData" in action and what == "properties":
            action["metaData"] = action["metaData"] | {
                "configuration": {FORGED: "x" * n, "delta.dataSkippingNumIndexedCols": str(size)}
            }
    if what == "many":
        adds = [action for action in actions if "add" in action]
        actions += [{"add": adds[0]["add"] | {"path": f"x{k}.parquet"}} for k in range(20_000)] if adds else []
    text = "\n".join(map(json.dumps, actions))
    return f"commit: {what}", (json_text(list(good), rng)[1] if what == "text" else text.encode())


def parquet(good: pa.Table, rng: Rng) -> Crafted:
    import pyarrow.parquet as pq

    sink = io.BytesIO()
    n = int(pick(rng, (10**6, 3 * 10**7)))
    what = pick(rng, ("rows", "long texts", "metadata", "footer", "nested", "count"))
    if what in ("rows", "count"):
        table = pa.table({"attempt_id": pa.DictionaryArray.from_arrays(np.zeros(n, np.int32), ["0" * 32])})
    elif what == "long texts":
        table = good.set_column(0, good.column_names[0], pa.array(["x" * n] * good.num_rows))
    elif what == "nested":
        table = good.append_column(FORGED, pa.array([nested(40)] * good.num_rows))
    else:
        table = good.replace_schema_metadata({b"x": b"y" * n})
    pq.write_table(table, sink, compression="zstd")
    data = sink.getvalue()
    if what == "footer":
        data = data[:-8] + struct.pack("<I", int(pick(rng, SIZES)) & 0xFFFFFFFF) + b"PAR1"
    if what == "count":  # the footer's zigzag numbers of rows
        old, new = (_zigzag(k) for k in (n, int(pick(rng, SIZES))))
        data = data.replace(old, new[: len(old) - 1] + bytes([new[len(old) - 1] & 0x7F]))
    return f"parquet: {what}", data


def _zigzag(n: int) -> bytes:
    n, out = n << 1, bytearray()
    while n > 0x7F:
        out.append(n & 0x7F | 0x80)
        n >>= 7
    return bytes([*out, n])
