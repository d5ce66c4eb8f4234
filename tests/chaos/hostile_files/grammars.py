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
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from safetensors.numpy import save

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
YAML_KEYS = ("tokens", "log_names", "max_scenes", "num_history_frames", "all_mapping", "_target_", FORGED[1:])


def pick(rng: Rng, options: Sequence[Any]) -> Any:
    return options[int(rng.integers(len(options)))]


def one_of(kind: str, options: Mapping[str, Any], rng: Rng) -> tuple[str, Any]:
    name = pick(rng, list(options))
    return f"{kind}: {name}", options[name]


def shared(kind: type) -> Any:
    """3^60 or 2^60 values to whoever walks through them."""
    value: Any = kind()
    for _ in range(60):
        value = {"a": value, "b": value} if kind is dict else kind((value, value, value))
    return value


def nested(depth: int) -> Any:
    return [nested(depth - 1)] if depth else 0


VALUES: dict[str, Callable[[Rng], Any]] = {
    "shared": lambda rng: shared(pick(rng, (tuple, list, dict))),
    "holds itself": lambda rng: pickle.loads(pick(rng, (b"]q\0h\0a.", b"}q\0U\1ah\0s."))),  # a list, a dict
    "nested": lambda rng: nested(pick(rng, (90, 150, 300))),
    "huge integer": lambda rng: pick(rng, (1, -1)) * 10 ** pick(rng, (30, 308, 309, 400, 5000, 100_000)),
    "huge text": lambda rng: pick(rng, ("x", "\n", "é", "\ud800")) * pick(rng, MANY),
    "huge float": lambda rng: pick(rng, (1e308, -1e308, 1e-320, float("nan"), float("inf"))),
    "forged text": lambda rng: pick(rng, (FORGED, f"a{FORGED}", "../../../etc/passwd", "/dev/zero", "\0", "")),
    "bytes": lambda rng: pick(rng, (b"", b"\xff" * pick(rng, MANY))),
    "huge array": lambda rng: np.full(pick(rng, MANY), pick(rng, (1e308, np.nan, 0.0))),
    "odd array": lambda rng: np.zeros(pick(rng, ((), (0, 3), (1, 1, 1, 1), (121, 0))), pick(rng, ("f8", "S5", "?"))),
    "text array": lambda rng: np.array([FORGED] * pick(rng, (1, 121))),
    "many keys": lambda rng: {f"{k}{FORGED}": k for k in range(pick(rng, MANY[:2]))},
    "odd keys": lambda rng: {pick(rng, (None, True, 1.5, (), (FORGED,), -1, 10**4999, float("nan"))): {}},
    "colliding keys": lambda rng: dict.fromkeys((k * PRIME for k in range(pick(rng, (3, 3000)))), 0),
}


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


def told(raw: bytes, form: str = "<I", more: int = 0) -> bytes:
    """Behind its length, and so many bytes more."""
    return struct.pack(form, len(raw) + more) + raw


def long4(n: int) -> bytes:
    return b"\x8b" + told(n.to_bytes(n.bit_length() // 8 + 1, "little", signed=True))


def colliding_keys(n: int, rng: Rng) -> bytes:
    """Integers of one hash, as keys, in tuples that are keys, and in sets."""
    forms = ((b"}(", b"N", b"u"), (b"}(", b"\x85N", b"u"), (b"\x8f(", b"", b"\x90"), (b"(", b"", b"\x91"))
    begin, between, end = pick(rng, (*forms, (b"cbuiltins\nset\n(](", b"", b"etR")))
    return begin + b"".join(long4(k * PRIME) + between for k in range(1, n + 1)) + end


def array(shape: Sequence[int], kind: bytes, raw: bytes = b"") -> bytes:
    """numpy's own program for an array."""
    start = b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(K\x00tC\x01btR(K\x01("
    spec = b"tcnumpy\ndtype\n(X" + told(kind) + b"I00\nI01\ntR(K\x03U\x01<NNNJ\xff\xff\xff\xff"
    return start + b"".join(map(long4, shape)) + spec + b"J\xff\xff\xff\xffK\x00tbI00\nB" + told(raw) + b"tb"


def program(rng: Rng) -> Crafted:
    """A pickle that is no value of Python's, or one that Python would not write."""
    n, size = pick(rng, MANY), pick(rng, SIZES)
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
        "copies of a text": b"]X" + told(b"x" * n) + b"q\1(" + b"h\1" * 5000 + b"e",
        "copies of an array": b"]" + array((n,), b"u1", b"\0" * n) + b"q\1a(" + b"h\1" * 5000 + b"e",
        "tuples of a tuple": b"(" + b"K\1" * n + b"tq\1" + b"cbuiltins\nlist\n(h\1tR" * 1000,
        "a shared kind": b"cnumpy.core.multiarray\n_reconstruct\n()" + b"q\1h\1h\1\x87" * 60 + b"K\0U\1btR",
        "colliding keys": colliding_keys(pick(rng, (1000, 30_000)), rng),
        "nothing": pick(rng, (b"", b"0", b"(((", b"\xff", b"u", b"}Nb")),
    }
    name, body = one_of("program", bodies, rng)
    return name, pick(rng, (b"\x80\x02", b"\x80\x04", b"")) + body + pick(rng, (b".", b".", b""))


def scenario(rng: Rng) -> Crafted:
    if rng.random() < 0.35:
        return program(rng)
    name, make = one_of("scenario", VALUES, rng)
    what, good = make(rng), pick(rng, (nuscenes, waymo, nuplan))()
    return name, pickle.dumps(planted(good, rng, what), int(rng.integers(2, 6)))


def frames(good: list[dict[str, Any]], rng: Rng) -> Crafted:
    if rng.random() < 0.25:
        return program(rng)
    if rng.random() < 0.1:
        return "frames: many", pickle.dumps(good * pick(rng, (100, 400)), int(rng.integers(2, 6)))
    name, make = one_of("frames", VALUES, rng)
    return name, pickle.dumps(planted(good, rng, make(rng), 0.9), int(rng.integers(2, 6)))


def npy(rng: Rng) -> Crafted:
    size, n = pick(rng, SIZES), pick(rng, (100, 9_000))
    kinds = ("'<f8'", "'|O'", "'<U99999999'", f"'V{size}'", "[('a','<f8',(99999,))]", repr(FORGED), "'<M8[as]'")
    shapes = (f"({size},)", f"({size},0,{size})", "(-1,)", "(9,40,3)", f"(9,40,{'9' * n})", f"({'1,' * n})", "(1e308,)")
    texts = {
        "shape": f"{{'descr': '<f8', 'fortran_order': False, 'shape': {pick(rng, shapes)}, }}\n",
        "kind": f"{{'descr': {pick(rng, kinds)}, 'fortran_order': True, 'shape': {pick(rng, shapes)}, }}\n",
        "deep": "(" * n + ")" * n,
        "signs": "-" * n + "1",
        "keys": "{" + ", ".join(f"'{k}': {k}" for k in range(n // 20)) + "}",
        "an expression": "__import__('os').system('true')",
    }
    (name, text), length, version = one_of("npy", texts, rng), pick(rng, (0, 0, 0, size)), int(rng.integers(1, 4))
    length = struct.pack("<I", (length or len(text)) & 0xFFFFFFFF)[: 2 if version == 1 else 4]
    raw = text.encode("latin1" if version < 3 else "utf-8")
    return name, b"\x93NUMPY" + bytes([version, 0]) + length + raw + bytes(pick(rng, (0, 8640)))


def array_file(rng: Rng) -> Crafted:
    return (npz if rng.random() < 0.2 else npy)(rng)


def deflated(head: bytes, n_bytes: int, wbits: int) -> bytes:
    """The head and zeros, which are packed once and repeated; a checksum at its end is wrong."""
    packer = zlib.compressobj(9, zlib.DEFLATED, wbits)
    start = packer.compress(head) + packer.flush(zlib.Z_FULL_FLUSH)
    million = packer.compress(bytes(10**6)) + packer.flush(zlib.Z_FULL_FLUSH)
    return start + million * (n_bytes // 10**6) + packer.flush()


def npz(rng: Rng) -> Crafted:
    what, name = pick(rng, ("bomb", "members", "headers")), "trajectories.npy"
    if what == "bomb":
        n = 960 * pick(rng, (10**5, 2 * 10**6))
        text = f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({n // 960},40,3), }}\n"
        head = b"\x93NUMPY\1\0" + told(text.encode(), "<H")
        body = deflated(head, n, -15)
        facts = struct.pack("<HHHHHIIIHH", 20, 0, 8, 0, 0, 0, len(body), n + len(head), len(name), 0)
        entry = b"PK\1\2\x14\0" + facts + bytes(14) + name.encode()
        end = struct.pack("<HHHHIIH", 0, 0, 1, 1, len(entry), 30 + len(name) + len(body), 0)
        return "npz: bomb", b"PK\3\4" + facts + name.encode() + body + entry + b"PK\5\6" + end
    names = [name, "digest.npy"] if what == "headers" else [f"../{FORGED}{k}.npy" for k in range(2_000)]
    return f"npz: {what}", zipped(((each, npy(rng)[1]) for each in names), zipfile.ZIP_DEFLATED)


def zipped(members: Iterable[tuple[str, str | bytes]], method: int) -> bytes:
    with zipfile.ZipFile(sink := io.BytesIO(), "w", method) as packed:
        for name, content in members:
            packed.writestr(zipfile.ZipInfo(name), content, method)  # of 1980, whenever it is made
    return sink.getvalue()


def arrow(good: pa.Table, rng: Rng) -> Crafted:
    """A table like a good one, where a column is another, or all are longer."""
    if rng.random() < 0.1:
        length = struct.pack("<I", pick(rng, SIZES) & 0x7FFFFFFF)
        return "arrow: length of its footer", b"ARROW1\0\0" + bytes(64) + length + b"ARROW1"
    rows, name, n = max(good.num_rows, 1), pick(rng, good.column_names), pick(rng, (10**6, 10**7))
    kind, most = good.schema.field(name).type, sum(pa.nulls(1000, f.type).nbytes // 1000 + 1 for f in good.schema)
    extremes = (1e308, -1e308, np.nan) if pa.types.is_floating(kind) else (2**63 - 1, -(2**63), 2**31)
    columns: dict[str, Callable[[], pa.Array]] = {
        "extremes": lambda: pa.array([pick(rng, extremes)] * rows),
        "forged texts": lambda: pa.array([FORGED] * rows),
        "nested": lambda: pa.array([nested(60)] * rows),
        "long texts": lambda: pa.DictionaryArray.from_arrays(np.zeros(rows, np.int32), ["x" * n]),
        "nulls": lambda: pa.nulls(rows),
        "runs": lambda: pa.RunEndEncodedArray.from_arrays(pa.array([rows], pa.int64()), pa.array([1e308])),
        "odd stamps": lambda: pa.array([2**62] * rows, pa.timestamp("ns")),
    }
    tables: dict[str, Callable[[], pa.Table]] = {
        "rows": lambda: pa.table([pa.nulls(min(n, 10**9 // most), f.type) for f in good.schema], schema=good.schema),
        "rows of nothing": lambda: pa.table(dict.fromkeys(good.column_names, pa.nulls(pick(rng, (10**6, 2**31 - 1))))),
        "many columns": lambda: pa.table({f"{k}": pa.nulls(rows) for k in range(20_000)}),
        "names": lambda: good.rename_columns([FORGED if c == name else c for c in good.column_names]),
    }
    what, at = pick(rng, [*columns, *tables]), good.column_names.index(name)
    table = tables[what]() if what in tables else good.set_column(at, name, columns[what]())
    sink, options = io.BytesIO(), pa.ipc.IpcWriteOptions(compression=pick(rng, ("zstd", "lz4")))
    with pa.ipc.new_file(sink, table.schema, options=options) as writer:
        writer.write_table(table)
    return f"arrow: {what}", sink.getvalue()


def json_text(good: Any, rng: Rng) -> Crafted:
    """A text with a value in it that JSON can say, or one that is cut."""
    n, mark = pick(rng, MANY), "@@here@@"
    words = {"1e308": "1e308", "1e999": "-1e999", "NaN": "NaN", "digits": "9" * n, "open": "[" * n}
    words |= {"deep": "[" * n + "]" * n, "objects": '{"a":' * n}
    name, word = one_of("json", words | {"forged": json.dumps(FORGED), "long": json.dumps("x" * n)}, rng)
    text = json.dumps(planted(good, rng, mark, 0.9)) if rng.random() < 0.8 else f'"{mark}"'
    return name, text.replace(f'"{mark}"', word, 1).encode()


def yaml_text(rng: Rng) -> Crafted:
    n, kind = pick(rng, (60, 3_000, 60_000)), pick(rng, ("[*a{0}, *a{0}, *a{0}]", "{{x: *a{0}, y: *a{0}}}"))
    aliases = ["&a0 [x]", *(f"&a{k} {kind.format(k - 1)}" for k in range(1, 60))]
    merges = ["&a0 {x: 1}", *("&a{} {{<<: [*a{}, *a{}, *a{}]}}".format(k, *[k - 1] * 3) for k in range(1, 40))]
    bodies = {"aliases": "\n".join(f"  - {line}" for line in aliases), "itself": " &a [*a, *a]"}
    bodies |= {"itself as a key": " &a {? *a : 1}", "merges": " &a {<<: [*a, *a]}"}
    bodies |= {"merges of merges": "\n" + "".join(f"  - {line}\n" for line in merges)}
    bodies |= {"digits": " " + pick(rng, ("", "-", "0x", "0b", "0")) + "1" * n, "sixties": " " + ":".join(["59"] * n)}
    bodies |= {"deep": " " + "[" * n, "deep blocks": " " + "- " * min(n, 3000) + "1"}
    bodies |= {"a tag": " !!python/object/apply:os.system [true]", "bytes": " !!binary " + "AAAA" * n}
    bodies |= {"a date": " 9999-99-99T99:99:99Z"}
    bodies |= {"colliding keys": "\n" + "".join(f"  {k * PRIME}: 0\n" for k in range(1, n))}
    bodies |= {"long text": " " + pick(rng, ("x", "é")) * n, "forged": " " + json.dumps([FORGED])}
    bodies |= {"many keys": "\n" + "".join(f"k{k}: 1\n" for k in range(n)), "1e308": " [1.0e+308, .inf, .nan]"}
    name, body = one_of("yaml", bodies, rng)
    return name, f"{json.dumps(pick(rng, YAML_KEYS))}:{body}\n".encode()


def ply(rng: Rng) -> Crafted:
    size, n = pick(rng, SIZES), pick(rng, (1000, 20_000))
    head, _, body = to_ply(scene().background).partition(b"end_header\n")
    lines = head.decode().splitlines()
    at = next(k for k, line in enumerate(lines) if line.startswith("element vertex"))
    heads = {
        "values": lines,
        "count": [*lines[:at], f"element vertex {pick(rng, (size, '9' * n, '-1'))}", *lines[at + 1 :]],
        "properties": [*lines, *(f"property float p{k}" for k in range(n))],
        "doubled": [*lines, *lines[at + 1 :]],
        "lists": [*lines[: at + 1], "property list uint float x", *lines[at + 1 :]],
        "elements": [*lines[:1], *(f"element e{k} {size}" for k in range(n)), *lines[1:]],
        "a kind": [line.replace("float", pick(rng, ("double", FORGED[1:], "uchar", "f8" * 9))) for line in lines],
        "a format": [line.replace("binary_little_endian", FORGED[1:]) for line in lines],
        "a comment": [lines[0], "comment " + "x" * n * 100, *lines[1:]],
    }
    name, lines = one_of("ply", heads, rng)
    if name == "ply: values":
        body = struct.pack("<f", pick(rng, (3e38, np.nan, np.inf, 0.0))) * (len(body) // 4)
    return name, "\n".join([*lines, "end_header", ""]).encode() + body


def spz(rng: Rng) -> Crafted:
    count, degree, bits = pick(rng, (0, 1, 10**6, 10**7, 2**32 - 1)), pick(rng, (0, 3, 4, 255)), pick(rng, (0, 255))
    head = struct.pack("<IIIBBBB", 0x5053474E, int(rng.integers(0, 6)), count, degree, bits, pick(rng, (0, 255)), 0)
    if rng.random() < 0.5:
        return "spz: gzip", deflated(head, pick(rng, (10**6, 10**8, 10**9)), 31)
    n, sizes = pick(rng, (0, 5, 6)), [count * each for each in (9, 1, 3, 3, 4, 45)]
    frames = [zstd_zeros(min(size, 10**9)) for size in sizes[:n]]
    told = (struct.pack("<QQ", pick(rng, (len(frame), 2**62)), size) for frame, size in zip(frames, sizes))
    start = head[:15] + bytes([n]) + struct.pack("<I", pick(rng, (32, 0, 2**32 - 1))) + bytes(12)
    return "spz: zstd", b"".join([start, *told, *frames])


def zstd_zeros(n_bytes: int) -> bytes:
    """One frame of blocks that each repeat a byte (RFC 8878); of no told size."""
    block = struct.pack("<I", 1 << 1 | 2**17 << 3)[:3] + b"\0"
    return b"\x28\xb5\x2f\xfd\x00\x58" + block * (n_bytes // 2**17) + bytes([block[0] | 1]) + block[1:]


def safetensors(rng: Rng) -> Crafted:
    """With its digest where it is a scene: who writes a file knows how to compute it."""
    size, n, name = pick(rng, SIZES), pick(rng, MANY), pick(rng, ("header", "described", "tensors"))
    tensors, described = dict(scene_tensors(scene())), scene_header(scene())
    if name == "header":
        kind, shape = pick(rng, ("F32", "U8", FORGED)), pick(rng, ([size, size], [0, size], [4], []))
        one = {"dtype": kind, "shape": shape, "data_offsets": [0, pick(rng, (4, 0, size))]}
        metadata = {KEY: pick(rng, ("[" * n, "9" * n, "NaN", json.dumps(FORGED), "{}" + " " * n))}
        many = {f"{FORGED}{k}": one for k in range(10_000)}
        text = json.dumps(pick(rng, ({"a": one}, {"a": one, "b": one}, many, {"__metadata__": metadata}))).encode()
        return "safetensors: header", struct.pack("<Q", pick(rng, (len(text), len(text), size))) + text + bytes(4)
    if name == "tensors":
        key = pick(rng, list(tensors))
        wrong = np.full(tensors[key].shape, pick(rng, (np.nan, 3e38)), np.float32)
        tensors[key] = pick(rng, (np.zeros((0, 3)), wrong, np.zeros(n), np.ascontiguousarray(tensors[key], "i8")))
    else:
        what = pick(rng, ("x" * n, FORGED, 1e308, 10**400, None, -1, [[]] * n, {FORGED: 1}, nested(90), True))
        described = {"version": 1, **described, pick(rng, list(described)): planted(described, rng, what, 0.9)}
    try:
        digest = scene_digest(tensors, described)
    except (ValueError, TypeError):  # no JSON of ours, as infinity is none
        digest = "0" * 64
    return f"safetensors: {name}", save(tensors, {KEY: json.dumps(described | {"digest": digest, "kept_as": "x"})})


def checkpoint(rng: Rng) -> Crafted:
    """What torch's own loader takes for tensors, and what it should not."""
    torch.set_num_threads(1)  # others are not there in a fork, which would wait for them
    size, n, one, sink = pick(rng, (10**5, 2**40, 2**62)), pick(rng, MANY), torch.zeros(1), io.BytesIO()
    if rng.random() < 0.3:
        (name, body), method = program(rng), pick(rng, (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))
        members = {"data.pkl": body, "version": "3\n", "byteorder": pick(rng, ("little", FORGED)), "data/0": bytes(n)}
        return f"checkpoint: {name}", zipped(((f"archive/{k}", content) for k, content in members.items()), method)
    tensors: dict[str, Callable[[], Any]] = {
        "strides of 0": lambda: one.expand(pick(rng, (10**6, 10**9, 10**11))),
        "sparse": lambda: torch.sparse_coo_tensor(torch.zeros((1, 1), dtype=torch.int64), one, (size,)),
        "sparse rows": lambda: torch.sparse_csr_tensor(torch.tensor([0, 1]), torch.tensor([0]), one, (1, size)),
        "meta": lambda: torch.empty(min(size, 2**60), device="meta"),
        "quantised": lambda: torch.quantize_per_tensor(one, 1e-30, 0, torch.qint8),
        "of few bits": lambda: torch.zeros(n, dtype=pick(rng, (torch.bfloat16, torch.float8_e4m3fn, torch.complex64))),
        "nan": lambda: torch.full((n, 3), pick(rng, (torch.nan, torch.inf, 3e38))),
        "empty": lambda: torch.empty((0, size)),
        "a parameter": lambda: torch.nn.Parameter(one.expand(10**9)),
        "a value": lambda: VALUES[pick(rng, ("shared", "holds itself", "huge integer", "huge text", "odd keys"))](rng),
    }
    name, tensor = one_of("checkpoint", tensors, rng)
    widths = {"means": 3, "quats": 4, "scales": 3, "opacities": 1, "features_dc": 3, "features_rest": 0}
    gauss = {f"_model.gauss_params.{key}": torch.zeros(2, width) for key, width in widths.items()}
    inside = dict(pick(rng, (gauss, {"agent._transfuser_model._status_encoding.weight": torch.zeros(2)})))
    inside[pick(rng, [*inside, FORGED])] = tensor()
    torch.save(pick(rng, (inside, {"state_dict": inside}, {"pipeline": inside, "step": 10**4000})), sink)
    return name, sink.getvalue()


def chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png(rng: Rng) -> Crafted:
    if rng.random() < 0.2:  # a whole one
        side, between = pick(rng, (10_000, 20_000, 30_000)), b""
        name, head = f"png: {side} a side", struct.pack(">IIBBBBB", side, side, 8, 0, 0, 0, 0)
        pixels = deflated(b"", side * (side + 1) + 10**6, 15)
    else:
        width, height = (pick(rng, (0, 1, 64, 8192, 65_535, 2**31 - 1, 2**32 - 1)) for _ in range(2))
        form = pick(rng, (1, 8, 16, 3)), pick(rng, (0, 2, 3, 6, 7)), 0, 0, pick(rng, (0, 1, 9))
        head, pixels = struct.pack(">II5B", width, height, *form), deflated(b"", pick(rng, (0, 10**6, 10**9)), 15)
        extra = {
            "plain": b"",
            "second header": chunk(b"IHDR", struct.pack(">IIBBBBB", 30_000, 30_000, 8, 2, 0, 0, 0)),
            "profile": chunk(b"iCCP", b"a\0\0" + pixels),
            "text": chunk(b"zTXt", b"a\0\0" + pixels) * 20,
            "palette": chunk(b"PLTE", b"\0" * 3 * 300),
            "length": struct.pack(">I", 2**31 - 1) + b"tEXt",
            "many": chunk(b"tEXt", b"a\0b") * 100_000,
        }
        name, between = one_of("png", extra, rng)
    chunks = (chunk(b"IHDR", head), between, chunk(b"IDAT", pixels), chunk(b"IEND", b""))
    return name, b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


def jpeg(rng: Rng) -> Crafted:
    """Headers, and pictures of many scans of nothing."""
    parts = pick(rng, (1, 3, 4))
    sizes = bytes(f for k in range(parts) for f in (k + 1, pick(rng, (0x11, 0x22, 0x44)), 0))

    def segment(marker: int, body: bytes) -> bytes:
        return bytes([0xFF, marker]) + told(body, ">H", 2)

    def frame(kind: int, width: int, height: int) -> bytes:
        return segment(kind, struct.pack(">BHHB", 8, height, width, parts) + sizes)

    width, height = (pick(rng, (0, 1, 64, 4096, 8192, 65_535)) for _ in range(2))
    all_parts = bytes([parts, *(f for k in range(parts) for f in (k + 1, 0))])
    tables = segment(0xDB, b"\0" + b"\1" * 64) + b"".join(segment(0xC4, bytes([k, 1, *[0] * 16])) for k in (0, 0x10))
    one, first = (tables + segment(0xDA, all_parts + bytes(to)) + b"\0" * 64 for to in ((0, 63, 0), (0, 0, 1)))
    runs = segment(0xC4, bytes([0x10, 1, *[0] * 15, 0xE0]))  # 16,384 blocks without a coefficient in 15 bits
    idle = runs + (segment(0xDA, bytes([1, 1, 0, 1, 63, 0])) + b"\x7f" * 4) * pick(rng, (20, 400))
    plain = frame(pick(rng, (0xC0, 0xC3, 0xC9)), width, height) + one
    shapes = {
        "plain": plain,
        "two frames": frame(0xC0, 64, 36) + frame(0xC2, width, height) + one,
        "scans": frame(0xC2, 8192, 8192) + first + idle,
        "scans of a small one": frame(0xC2, 1920, 1200) + first + idle * 4,
        "lines told later": frame(0xC0, width, 0) + one + segment(0xDC, b"\xff\xff"),
        "exif": segment(0xE1, b"Exif\0\0II*\0" + struct.pack("<I", 2**32 - 1)) + plain,
        "thumbnail": segment(0xE1, frame(0xC0, 64, 36)) + plain,
        "many segments": segment(0xFE, b"x") * 100_000 + plain,
        "filler": b"\xff" * 10**6 + plain,
    }
    name, body = one_of("jpeg", shapes, rng)
    return name, b"\xff\xd8" + body + b"\xff\xd9"


def picture(rng: Rng) -> Crafted:
    if made := pick(rng, (png, jpeg, jpeg, None)):
        return made(rng)
    side = pick(rng, SIZES) & 0x7FFFFFFF
    heads = {
        "bmp": b"BM" + struct.pack("<IHHIIiiHHIIiiII", 54, 0, 0, 54, 40, side, side, 1, 24, *[0] * 6),
        "tiff": b"II*\0" + struct.pack("<I", 2**32 - 1),
        "webp": b"RIFF" + struct.pack("<I", side) + b"WEBPVP8L" + b"\xff" * 20,
        "pfm": b"PF\n%d %d\n-1.0\n" % (side, side),
        "hdr": b"#?RADIANCE\n\n-Y %d +X %d\n" % (side, side),
        "pnm": b"P6 %d %d 255\n" % (side, side),
        "avif": b"\0\0\0\x1cftypavif" + b"\xff" * 60,
    }
    return one_of("picture", heads, rng)


def mcap(rng: Rng) -> Crafted:
    size, kind, squeezed = pick(rng, SIZES), pick(rng, (b"zstd", b"lz4", FORGED.encode())), zstd_zeros(15 * 10**8)
    head = struct.pack("<QQQI", 0, 1, pick(rng, (15 * 10**8, size)), 0) + told(kind)
    bodies = {
        "chunk bomb": (b"\6" + told(head + told(squeezed, "<Q"), "<Q")) * pick(rng, (1, 4)),
        "length": b"\6" + struct.pack("<Q", size),
        "length of a text": b"\3" + told(struct.pack("<HI", 1, size & 0xFFFFFFFF), "<Q"),
        "many": (b"\x0f" + told(bytes(4), "<Q")) * 100_000,
        "opcodes": bytes([int(rng.integers(16, 256))]) + told(b"x" * 100, "<Q"),
    }
    name, body = one_of("mcap", bodies, rng)
    footer = b"\2" + told(struct.pack("<QQI", pick(rng, (0, 30, size)), pick(rng, (0, size)), 0), "<Q")
    return name, b"\x89MCAP0\r\n\1" + told(bytes(8), "<Q") + body + footer + b"\x89MCAP0\r\n"


def commit(good: Sequence[dict[str, Any]], rng: Rng) -> Crafted:
    """A log's first commit: actions like a good one's with lies among them."""
    n, size = pick(rng, MANY), pick(rng, SIZES)
    paths = ("../../../../etc/passwd", "/etc/passwd", "file:///etc/passwd", "s3://x/y", "%2e%2e/x", FORGED, "", "x" * n)
    least = f'{{"numRecords": {size}, "minValues": {{"clip_id": "{"z" * n}"}}}}'
    stats = ("x" * n, "[" * n, '{"numRecords": 1e308}', least)
    schemas = ("[" * n, "", '{"type":"struct","fields":' * min(n, 9999), '{"type": "struct", "fields": []}')
    lies: dict[str, tuple[str, dict[str, Any]]] = {
        "path": ("add", {"path": pick(rng, paths)}),
        "statistics": ("add", {"stats": pick(rng, stats)}),
        "size": ("add", {"size": pick(rng, (size, -1, 0))}),
        "partition": ("add", {"partitionValues": {FORGED: FORGED, **{f"{k}": "x" for k in range(min(n, 9999))}}}),
        "value": ("add", {"modificationTime": pick(rng, (1e308, None, [], FORGED, -1))}),
        "schema": ("metaData", {"schemaString": pick(rng, schemas)}),
        "properties": ("metaData", {"configuration": {FORGED: "x" * n}}),
        "protocol": ("protocol", {"minReaderVersion": size & 0x7FFFFFFF, "readerFeatures": [FORGED]}),
    }
    if (what := pick(rng, [*lies, "many", "text"])) == "text":
        return "commit: text", json_text(list(good), rng)[1]
    key, lie = lies.get(what, ("", {}))
    actions = [{name: body | lie if name == key else body for name, body in action.items()} for action in good]
    if what == "many":
        add = next(action["add"] for action in good if "add" in action)
        actions += [{"add": add | {"path": f"x{k}.parquet"}} for k in range(20_000)]
    return f"commit: {what}", "\n".join(map(json.dumps, actions)).encode()


def parquet(good: pa.Table, rng: Rng) -> Crafted:
    n, what = pick(rng, (10**6, 3 * 10**7)), pick(rng, ("rows", "texts", "metadata", "footer", "nested"))
    tables = {
        "rows": lambda: pa.table({"attempt_id": pa.DictionaryArray.from_arrays(np.zeros(n, np.int32), ["0" * 32])}),
        "texts": lambda: good.set_column(0, good.column_names[0], pa.array(["x" * n] * good.num_rows)),
        "nested": lambda: good.append_column(FORGED, pa.array([nested(40)] * good.num_rows)),
    }
    table = tables.get(what, lambda: good.replace_schema_metadata({b"x": b"y" * n}))()
    pq.write_table(table, sink := io.BytesIO(), compression="zstd")
    data = sink.getvalue()
    if what == "footer":
        data = data[:-8] + struct.pack("<I", pick(rng, SIZES) & 0xFFFFFFFF) + b"PAR1"
    return f"parquet: {what}", data
