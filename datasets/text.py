"""Numbers in sentences."""

import re


def plural(count: int, noun: str) -> str:
    """A number with its noun: ``1 episode``, ``3 episodes``."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def capitalised(text: str) -> str:
    """The text with a capital first letter; symbols, such as ``x``, and the other letters stay as they are."""
    return text[:1].upper() + text[1:] if len(text) > 1 else text


def percent(share: float, form: str = ".0f") -> str:
    """A share in percent: ``38 %``. form: format of the number; zero has no minus sign."""
    return f"{100.0 * share:{form.replace('.', 'z.', 1)}} %"


def typeset(text: str) -> str:
    """The text set as on the page: minus signs, but not in names and ranges, arrows and degree signs."""
    for pattern, character in (
        (r"(?<![\w).:=-])-(?=\.?\d)", "\N{MINUS SIGN}"),
        (r"(?<=\d) deg\b", "°"),
        (r"\(deg\b", "(°"),
    ):
        text = re.sub(pattern, character, text)
    return text.replace(" -> ", " → ")
