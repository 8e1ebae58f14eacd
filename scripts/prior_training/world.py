"""The captions of the embedded world that our own priors learn, and the cameras that they see it from."""

import zlib
from dataclasses import dataclass

import torch

from cadam3d.core.cameras import Cameras, orbit

PRIMITIVES = ("sphere", "cube", "torus", "cylinder", "cone", "capsule", "pyramid", "star", "arch", "ring")
OBJECTS = (
    "lighthouse",
    "snowman",
    "chair",
    "table",
    "mug",
    "rocket",
    "house",
    "mushroom",
    "car",
    "tree",
    "pine",
    "boat",
)
NOUNS = (*PRIMITIVES, *OBJECTS)
COLOURS = (
    "red",
    "orange",
    "yellow",
    "green",
    "cyan",
    "blue",
    "purple",
    "pink",
    "white",
    "black",
    "brown",
    "grey",
)
PATTERNS = ("striped", "checkered", "spotted")
RELATIONS = ("on", "next to")

VIEWS = 4  # of a group, a quarter turn apart, as prior=mvdream reads them
# One pair of colour and noun in this many occurs in no caption of the training set. Its pictures may occur:
# an object without a named colour has any colour or its own, and mushrooms are red.
HELD_OUT_EVERY = 8
ALWAYS_HELD_OUT = frozenset({("red", "mushroom")})

# Shares of captions: one object in one colour, or without a colour, or with a pattern; the rest have two
# objects.
PLAIN, OPEN, PATTERNED = 0.56, 0.06, 0.18
# The share of patterned objects whose second colour is named too.
SECOND = 0.4


def is_held_out(colour: str, noun: str) -> bool:
    """Return whether no caption of the training set has this object in this colour."""
    number = zlib.crc32(f"{colour} {noun}".encode())
    return (colour, noun) in ALWAYS_HELD_OUT or number % HELD_OUT_EVERY == 0


def held_out_captions() -> list[str]:
    """Return the captions of one object in one colour that training never reads."""
    return [with_article(f"{c} {n}") for n in NOUNS for c in COLOURS if is_held_out(c, n)]


@dataclass(frozen=True)
class Form:
    """What a caption says except the colours: one or two objects, whose colours can be drawn again."""

    nouns: tuple[str, ...]
    relation: str  # empty for one object
    pattern: str  # empty for a plain object
    colours: int  # that the caption names, per object


class Draw:
    """Random choices from one generator."""

    def __init__(self, generator: torch.Generator) -> None:
        self.generator = generator

    def uniform(self, low: float = 0.0, high: float = 1.0) -> float:
        """Return a number in [low, high)."""
        return low + (high - low) * float(torch.rand((), generator=self.generator))

    def one(self, choices: tuple[str, ...]) -> str:
        """Return one of the choices, all equally likely."""
        return choices[int(torch.randint(len(choices), (), generator=self.generator))]

    def form(self) -> Form:
        """Return what a caption describes, without its colours."""
        kind = self.uniform()
        if kind < PLAIN:
            return Form((self.one(NOUNS),), "", "", 1)
        if kind < PLAIN + OPEN:
            return Form((self.one(NOUNS),), "", "", 0)
        if kind < PLAIN + OPEN + PATTERNED:
            return Form((self.one(NOUNS),), "", self.one(PATTERNS), 2 if self.uniform() < SECOND else 1)
        return Form((self.one(NOUNS), self.one(NOUNS)), self.one(RELATIONS), "", 1)

    def caption(self, form: Form) -> str:
        """Return a caption of this form, with colours that are not held out."""
        phrases = [self._phrase(noun, form) for noun in form.nouns]
        return f" {form.relation} ".join(phrases)

    def _phrase(self, noun: str, form: Form) -> str:
        allowed = tuple(colour for colour in COLOURS if not is_held_out(colour, noun))
        first = self.one(allowed) if form.colours else ""
        second = ""
        if form.colours == 2:
            second = f"and {self.one(tuple(colour for colour in COLOURS if colour != first))}"
        return with_article(" ".join(filter(None, (first, second, form.pattern, noun))))

    def group(self, size: int) -> Cameras:
        """Return four cameras a quarter turn apart, mostly like those of camera=orbit.

        Some come closer or look through a narrower or wider lens, as the cameras of the published recipes do,
        and some look from high above.
        """
        kind = self.uniform()
        if kind < 0.85:
            low, high = -20.0, 60.0
        else:
            low, high = (60.0, 85.0) if kind < 0.95 else (-30.0, -20.0)
        # Equal areas of the sphere are equally likely.
        sines = torch.tensor([low, high]).deg2rad().sin().tolist()
        elevation = float(torch.tensor(self.uniform(*sines)).asin().rad2deg())
        fov = self.uniform(40.0, 45.0) if self.uniform() < 0.6 else self.uniform(15.0, 60.0)
        half_height = self.uniform(1.02, 1.4) if self.uniform() < 0.75 else self.uniform(0.85, 1.7)
        distance = half_height / float(torch.tensor(fov / 2).deg2rad().tan())
        azimuth = (self.uniform(-180.0, 180.0) + 90.0 * torch.arange(VIEWS) + 180.0) % 360.0 - 180.0
        one = torch.ones(VIEWS)
        return orbit(azimuth, elevation * one, max(distance, 1.5) * one, fov * one, size, size)


def with_article(phrase: str) -> str:
    """Return a noun phrase with "a" or "an" before it."""
    return f"{'an' if phrase[0] in 'aeiou' else 'a'} {phrase}"
