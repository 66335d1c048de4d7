"""Names as programming languages and formats allow them."""

import re
import unicodedata


def identifier(name: str) -> str:
    """A name as a Python identifier: k_2 for k^2, _1k for 1k."""
    name = re.sub(r"\W", "_", unicodedata.normalize("NFKC", name))  # as Python does: two spellings may be one identifier
    return name if name.isidentifier() else f"_{name}"


def in_ascii(name: str) -> str:
    """A name in the letters of C99: phi for φ."""
    return "".join(x if x.isascii() else _letter_in_words(x) for x in unicodedata.normalize("NFKD", name) if not unicodedata.combining(x))


def _letter_in_words(letter: str) -> str:
    *_, word = unicodedata.name(letter, "_").replace("-", "_").split()
    return word.capitalize() if letter.isupper() else word.lower()


def structured(name: str) -> str:
    """A name such as "wheel.phi[0, 1]" in the naming convention "structured" of FMI: others than identifiers in quotes, φ as phi."""
    parts = re.findall(r"([^.\[]+)(\[[\d, ]*\])?", in_ascii(name))
    written = [_part(part, bool(i)) + index.replace(" ", "") for i, (part, index) in enumerate(parts)]
    return ".".join(written).replace(".[", "[")


def _part(part: str, is_inner: bool) -> str:
    if is_inner and part.isdigit():
        return f"[{part}]"
    part = re.sub(r"[^\w!#$%&()*+,\-./:;<>=?@\[\]^{}|~ ]", "_", part, flags=re.ASCII)
    return part if re.fullmatch(r"[A-Za-z_]\w*", part, re.ASCII) else f"'{part}'"
