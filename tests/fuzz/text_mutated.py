"""Mutations of the text in which formats describe themselves: message definitions, variables, headers."""

import re
from random import Random

_TOKEN = re.compile(r"[A-Za-z0-9_]+|[^A-Za-z0-9_\s]")
_TOKENS = (
    "0", "1", "-1", "255", "65536", "4294967295", "99999999999999999999", "[]", "[4000000]", "[<=3]", "float64",
    "uint8", "string", "char", "bool", "=", "/", ":", ";", "#", ",", "\0", "é", "NaN", "1e999", "A" * 300,
)  # fmt: skip
_MOST_LINES = 3000


def mutate_text(rng: Random, text: str) -> str:
    """Returns `text` after a change of a token or of whole lines (lines end with a newline or a semicolon)."""
    end = "\n" if "\n" in text else ";"
    lines = text.split(end)
    at, choice = rng.randrange(len(lines)), rng.random()
    if choice < 0.6:
        lines[at] = _other_token(rng, lines[at], text)
    elif choice < 0.7:
        del lines[at]
    elif choice < 0.8:
        lines.insert(at, lines[at])
    elif choice < 0.9:
        other = rng.randrange(len(lines))
        lines[at], lines[other] = lines[other], lines[at]
    else:
        times = rng.choice((8, 64, 512))
        copies = [re.sub(r"(\w+)$", rf"\g<1>_{k}", lines[at]) for k in range(times)]
        lines[at:at] = copies[:_MOST_LINES]
    return end.join(lines)


def _other_token(rng: Random, line: str, text: str) -> str:
    """Another token of the same text, or one at which parsers tip over, in the place of one of `line`."""
    places = list(_TOKEN.finditer(line))
    if not places:
        return line + rng.choice(_TOKENS)
    place = rng.choice(places)
    known = _TOKEN.findall(text)
    return line[: place.start()] + rng.choice((rng.choice(known), rng.choice(_TOKENS))) + line[place.end() :]
