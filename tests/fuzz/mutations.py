"""Damage and malice, drawn at random: to bytes, to text, and to what an HDF5 file holds."""

import re
import zlib

import h5py
import numpy as np

NUMBERS = (
    "nan",
    "inf",
    "-inf",
    "1e308",
    "1e999",
    "-1",
    "0",
    "-0",
    "1e-320",
    "1000000000000",
    "9" * 5000,
    "0x10",
)
WORDS = (
    *NUMBERS, "", "x", "\x1b[31m\x07", "\u202eevil", "[red]", "{0}", "%s", "a\nb", "/dev/zero", "../../a",
    "<script>alert(1)</script>", "é", "'", '"', "\x00", "true", "[" * 3000, "LIST", "LOCAL", "=", ":",
)  # fmt: skip
VALUES = (np.nan, np.inf, -np.inf, 0.0, -1.0, 1.0, 1e300, -1e300, 1e-300, 1e12, 0.5, 2.0)
TYPES = ("f2", "f4", "f8", ">f8", "i1", "i8", ">i4", "u1", "u8", "?", "c8", "S5", "O", "V3", "compound")
CONTROLS = b"\x00\x1b\r\n\t =:,;#<>&\"'[]{}\xff\x80"


def of_bytes(rng, data):
    """Flip, cut, double, overwrite or drop pieces."""
    changed = bytearray(data)
    for _ in range(int(rng.integers(1, 5))):
        at, size = int(rng.integers(0, len(changed) + 1)), int(rng.integers(0, 40))
        how = rng.integers(0, 7)
        if how == 0 and changed:
            changed[at % len(changed)] = int(rng.integers(0, 256))
        elif how == 1 and changed:
            changed[at % len(changed)] ^= 1 << int(rng.integers(0, 8))
        elif how == 2:
            del changed[at : at + size]
        elif how == 3:
            changed[at:at] = changed[at : at + size]
        elif how == 4:
            changed[at : at + size] = rng.integers(0, 256, size, dtype=np.uint8).tobytes()
        elif how == 5:
            changed[at:at] = bytes([CONTROLS[int(rng.integers(0, len(CONTROLS)))]]) * (1 + size % 3)
        elif rng.random() < 0.3:
            del changed[at:]
    return bytes(changed)


def of_text(rng, data):
    """Replace words, drop, double and swap lines; sometimes bytes, too."""
    head, kept = data[:20_000], data[20_000:]
    for _ in range(int(rng.integers(1, 4))):
        how = rng.integers(0, 8)
        if how < 4:
            words = list(re.finditer(rb"[^\s,;=:<>\"\[\]]+", head))
            if words:
                word = words[int(rng.integers(0, len(words)))]
                new = WORDS[int(rng.integers(0, len(WORDS)))].encode("utf-8")
                head = head[: word.start()] + new + head[word.end() :]
        elif how < 7:
            lines = head.split(b"\n")
            i, j = (int(k) for k in rng.integers(0, len(lines), 2))
            if how == 4:
                del lines[i]
            elif how == 5:
                lines.insert(j, lines[i])
            else:
                lines[i], lines[j] = lines[j], lines[i]
            head = b"\n".join(lines)
        else:
            head = of_bytes(rng, head)
    return head + kept


def of_hdf5(rng, path):
    """Change what an HDF5 file holds, or its bytes."""
    for _ in range(1 + int(rng.random() < 0.3)):
        change = CHANGES[int(rng.integers(0, len(CHANGES)))]
        try:
            with h5py.File(path, "r+") as file:
                change(rng, file)
        # A change may not apply to what is there, or to what the change before it left.
        except (
            OSError,
            RuntimeError,
            ValueError,
            KeyError,
            TypeError,
            OverflowError,
            AttributeError,
            IndexError,
        ):
            continue
    if rng.random() < 0.1:
        path.write_bytes(of_bytes(rng, path.read_bytes()))


def picked(rng, file, kind=(h5py.Group, h5py.Dataset)):
    names = []
    file.visititems(lambda name, node: names.append(name) if isinstance(node, kind) else None)
    return names[int(rng.integers(0, len(names)))]


def drop(rng, file):
    del file[picked(rng, file)]


def values_of(file, name):
    """Values of a data set, unless another change made it absurd."""
    node = file[name]
    if (node.size or 0) > 10**6 or node.external or node.is_virtual:
        raise ValueError(f"{name}: not to be read any more")
    with np.errstate(all="ignore"):
        return np.asarray(node[()])


def put(file, name, values, **how):
    kept = dict(file[name].attrs)
    del file[name]
    file.create_dataset(name, data=values, **how)
    file[name].attrs.update(kept)


def retype(rng, file):
    name = picked(rng, file, h5py.Dataset)
    kind = TYPES[int(rng.integers(0, len(TYPES)))]
    values = values_of(file, name)
    if kind == "compound":
        put(file, name, np.zeros(values.shape, dtype=[("a", "f4"), ("b", "i2")]))
    elif kind == "O":
        put(file, name, np.full(values.shape, "\x1b[31m\n\u202e", dtype=object), dtype=h5py.string_dtype())
    else:
        put(file, name, np.zeros(values.shape, kind) if kind[0] in "SV" else values.astype(kind))


def resize(rng, file):
    name = picked(rng, file, h5py.Dataset)
    values = values_of(file, name)
    how = rng.integers(0, 6)
    if how == 0:
        values = values[:-1]
    elif how == 1:
        values = np.concatenate([values, values[-1:]])
    elif how == 2:
        values = values[:0]
    elif how == 3:
        values = values[None]
    elif how == 4:
        values = values.T
    else:
        values = values.reshape(-1)
    put(file, name, values)


def entries(rng, file):
    name = picked(rng, file, h5py.Dataset)
    values = values_of(file, name)
    value = VALUES[int(rng.integers(0, len(VALUES)))]
    if rng.random() < 0.5:
        flat = values.reshape(-1)
        flat[rng.integers(0, flat.size, 1 + flat.size // 20)] = value
    elif rng.random() < 0.5:
        values = values * np.asarray(value).astype(values.dtype)
    else:
        values = rng.permutation(values)
    put(file, name, values)


def attribute(rng, file):
    node = file if rng.random() < 0.3 else file[picked(rng, file)]
    names = list(node.attrs) or ["format"]
    name = names[int(rng.integers(0, len(names)))]
    how = rng.integers(0, 6)
    if how == 0:
        del node.attrs[name]
    elif how == 1:
        node.attrs[name] = VALUES[int(rng.integers(0, len(VALUES)))]
    elif how == 2:
        node.attrs[name] = WORDS[int(rng.integers(0, len(WORDS)))]
    elif how == 3:
        node.attrs[name] = np.full(int(rng.integers(0, 20)), VALUES[int(rng.integers(0, len(VALUES)))])
    elif how == 4:
        node.attrs[name] = h5py.Empty("f8")
    else:
        node.attrs.create(name, np.zeros(2, dtype=[("a", "f4"), ("b", "S3")]))


def relink(rng, file):
    name = picked(rng, file)
    links = (
        h5py.SoftLink("/none"),
        h5py.SoftLink(f"/{name}"),
        h5py.SoftLink("/"),
        h5py.SoftLink(f"/{picked(rng, file)}"),
        h5py.ExternalLink("/dev/zero", "/"),
        h5py.ExternalLink("none.h5", f"/{name}"),
        h5py.ExternalLink(file.filename, f"/{name}"),
        file["/"],
        file[picked(rng, file)],
        np.dtype("f8"),
    )
    new = links[int(rng.integers(0, len(links)))]
    del file[name]
    file[name] = new


def elsewhere(rng, file):
    name = picked(rng, file, h5py.Dataset)
    node, kept = file[name], dict(file[name].attrs)
    shape, kind = node.shape, node.dtype
    del file[name]
    if rng.random() < 0.5:
        target = ("/dev/zero", "/etc/passwd", file.filename, "none.raw")[int(rng.integers(0, 4))]
        file.create_dataset(name, shape, kind, external=[(target, 0, h5py.h5f.UNLIMITED)])
    else:
        layout = h5py.VirtualLayout(shape, kind)
        layout[...] = h5py.VirtualSource(("none.h5", ".")[int(rng.integers(0, 2))], name, shape)
        file.create_virtual_dataset(name, layout)
    file[name].attrs.update(kept)


def absurd(rng, file):
    name = picked(rng, file, h5py.Dataset)
    node, kept = file[name], dict(file[name].attrs)
    shape = list(node.shape or (1,))
    shape[int(rng.integers(0, len(shape)))] = 10 ** int(rng.integers(3, 13))
    if rng.random() < 0.5:
        shape = [*([10 ** int(rng.integers(6, 13))] if shape else []), *shape[1:]]
    kind = node.dtype
    del file[name]
    chunks = tuple(min(n, 4) for n in shape) if rng.random() < 0.7 else None
    file.create_dataset(name, tuple(shape), kind, chunks=chunks, compression="gzip" if chunks else None)
    file[name].attrs.update(kept)


def rechunk(rng, file):
    """Write chunks that unpack to fewer bytes than they claim, or to more, or to nothing."""
    name = picked(rng, file, h5py.Dataset)
    values = values_of(file, name)
    chunks = tuple(max(1, n // int(rng.integers(1, 3))) for n in values.shape)
    how = ({"compression": "gzip"}, {"compression": "lzf"}, {}, {"compression": "gzip", "fletcher32": True})
    put(file, name, values, chunks=chunks, shuffle=bool(rng.integers(0, 2)), **how[int(rng.integers(0, 4))])
    if rng.random() < 0.3:
        return
    node = file[name]
    offset = (0,) * values.ndim
    mask, raw = node.id.read_direct_chunk(offset)
    shorter = raw[: int(rng.integers(0, len(raw) + 1))]
    size = int(np.prod(chunks)) * values.itemsize
    choices = (
        shorter, of_bytes(rng, raw), zlib.compress(bytes(max(size - 1, 0))), zlib.compress(bytes(size + 1)),
        zlib.compress(bytes(10**7)), bytes(size), b"\x20\x00" * 10,
    )  # fmt: skip
    new = choices[int(rng.integers(0, len(choices)))]
    node.id.write_direct_chunk(offset, new, int(rng.integers(0, 4)) if rng.random() < 0.3 else mask)


def exchange(rng, file):
    one, other = picked(rng, file), picked(rng, file)
    file.move(one, "held")
    if other in file:
        file.move(other, one)
    file.move("held", other)


CHANGES = (
    drop, retype, retype, resize, resize, entries, entries, entries, attribute, attribute, attribute, relink,
    elsewhere, absurd, rechunk, rechunk, exchange,
)  # fmt: skip
