"""Pictures that are not as they should be: turned by their Exif data, or declared far larger than they are."""

import zlib

from factory.readers.pictures import PNG


def turned(picture: bytes, orientation: int) -> bytes:
    """A JPEG or PNG with Exif data that say so; its pixels are as they were."""
    entry = b"\x01\x12\x00\x03\x00\x00\x00\x01\x00" + bytes([orientation]) + bytes(2)
    tiff = b"MM\x00*\x00\x00\x00\x08\x00\x01" + entry + bytes(4)
    if picture.startswith(PNG):
        return (
            picture[:33]
            + len(tiff).to_bytes(4)
            + b"eXIf"
            + tiff
            + zlib.crc32(b"eXIf" + tiff).to_bytes(4)
            + picture[33:]
        )
    exif = b"Exif\x00\x00" + tiff
    return picture[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2) + exif + picture[2:]


def declared(picture: bytes, width: int, height: int) -> bytes:
    """A JPEG or PNG whose header says another size."""
    if picture.startswith(PNG):
        head = b"IHDR" + width.to_bytes(4) + height.to_bytes(4) + picture[24:29]
        return picture[:12] + head + zlib.crc32(head).to_bytes(4) + picture[33:]
    at = picture.index(b"\xff\xc0") + 5
    return picture[:at] + height.to_bytes(2) + width.to_bytes(2) + picture[at + 4 :]
