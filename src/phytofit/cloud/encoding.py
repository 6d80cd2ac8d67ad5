"""Bytes as they come from spreadsheets, shells and other systems, on their way to a reader."""

import codecs
import re

from phytofit.cloud.table import FileError

__all__ = ["content_fault", "decoded", "in_utf8"]

MARKS = (
    (codecs.BOM_UTF8, "utf-8"),
    (codecs.BOM_UTF32_LE, "utf-32-le"),  # before UTF-16, whose mark it begins with
    (codecs.BOM_UTF32_BE, "utf-32-be"),
    (codecs.BOM_UTF16_LE, "utf-16-le"),
    (codecs.BOM_UTF16_BE, "utf-16-be"),
)
OF_OTHER_TIMES = {0x1A: None, 0x0C: "\n"}  # the end of a file in DOS, and of a page
OF_TYPESETTERS = dict.fromkeys(map(ord, "\u00a0\u2009\u202f\u3000"), " ") | {
    ord("\u2212"): "-",
    0xFEFF: None,
}  # blanks, minus, mark
SAMPLE = 400  # bytes by which UTF-16 without a mark is told: one half of each character is zero in most
CONTENTS = (  # what a file is whose first bytes are these, and the suffixes that it may have, if it is a cloud
    (rb"\x00\x05\x16\x07", "a macOS resource file that lies beside the cloud, not a cloud; leave it out", ()),
    (rb"ply[ \t]*[\r\n]", "PLY", (".ply",)),
    (rb"LASF", "LAS", (".las", ".laz")),
    (rb"ASTM-E57", "E57", (".e57",)),
    (rb"# \.PCD", "PCD", (".pcd",)),
    (rb"PK\x03\x04|\x1f\x8b|BZh|\xfd7zXZ|7z\xbc\xaf|Rar!", "an archive; unpack it first", ()),
    (rb"%PDF|\x89PNG|\xff\xd8\xff|II\*\x00|MM\x00\*|GIF8", "a document or an image, not a cloud", ()),
    (rb"\s*<(?:!doctype|html|\?xml)", "a web page or XML, not a cloud; was it downloaded as the file itself?", ()),
    (rb"version https://git-lfs", "a Git LFS pointer; fetch the file itself with 'git lfs pull'", ()),
)


def in_utf8(data: bytes) -> bytes:
    """The bytes, as UTF-8 without a mark if they are text that is marked or was written as UTF-16."""
    encoding = next((name for mark, name in MARKS if data.startswith(mark)), None)
    encoding = encoding or _unmarked(data)
    if encoding is None:
        return data
    if encoding == "utf-8":
        return data.removeprefix(codecs.BOM_UTF8)
    try:
        return data.decode(encoding).removeprefix("\ufeff").encode()
    except UnicodeError as error:
        raise FileError(
            f"truncated or damaged: it starts as {encoding.upper()}, and goes on as something else"
        ) from error


def _unmarked(data: bytes) -> str | None:
    """UTF-16 without a mark, by its zeros: most of one half of the bytes, and none of the other."""
    low, high = data[:SAMPLE:2], data[1:SAMPLE:2]
    for zeros, others, name in ((high, low, "utf-16-le"), (low, high, "utf-16-be")):
        if 2 * zeros.count(0) > len(zeros) and 0 not in others:
            return name
    return None


def decoded(data: bytes) -> str:
    """Text with ``\\n`` at the ends of its lines; what is not UTF-8 is taken for Windows-1252, then Latin-1."""
    text = ""
    for encoding in ("utf-8", "cp1252", "latin-1"):
        try:
            text = data.decode(encoding)
        except UnicodeDecodeError:
            continue
        break
    plain = text if text.isascii() else text.translate(OF_TYPESETTERS)
    if any(chr(sign) in plain for sign in OF_OTHER_TIMES):
        plain = plain.translate(OF_OTHER_TIMES)
    return plain.replace("\r\n", "\n").replace("\r", "\n")


def content_fault(data: bytes, suffix: str) -> str | None:
    """What is wrong with a file whose content is not what its suffix says; None if nothing is."""
    for start, what, suffixes in CONTENTS:
        if re.match(start, data[:100], re.IGNORECASE):
            if not suffixes:
                return f"is {what}"
            return None if suffix in suffixes else f"is {what} by its content; name it {suffixes[0]}"
    return None
