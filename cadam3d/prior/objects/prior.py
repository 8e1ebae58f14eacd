"""ObjectsPrior: an exact diffusion model of a folder of textured meshes. MeshPrior: of a single one."""

from dataclasses import dataclass
from typing import Annotated

from cadam3d.core.checks import fail, one_of
from cadam3d.core.console import say
from cadam3d.io.frames import UPS
from cadam3d.prior.exact import ExactEmbedding, ExactPrior
from cadam3d.prior.objects.catalog import Entry, modes, read_catalog
from cadam3d.prior.objects.scene import MeshScene, read_object


@dataclass(frozen=True, kw_only=True)
class ObjectsPrior(ExactPrior):
    """A Gaussian mixture over images of the objects that a prompt names, one mode per object."""

    folder: str | None  # None: the objects that come with cadam3d

    def embed(self, prompt: str, negative: str) -> ExactEmbedding:
        """Find the objects of both prompts and say which they are. Raises as :meth:`scene` does."""
        embedding = super().embed(prompt, negative)
        names = ", ".join(entry.credit for entry in self.named(prompt))
        say(f"Objects for {prompt!r}: {names}")
        return embedding

    def scene(self, prompt: str, key: str = "prompt") -> MeshScene:
        """Return the objects that the prompt in the setting ``key`` names.

        Raises ``UserError`` if there is none, with the name that is spelled most like the prompt, and if a
        file cannot be read.
        """
        catalog, found = read_catalog(self.folder), self.named(prompt)
        if not found:
            known = "the name or a tag of an object" + (f" in {self.folder}" if self.folder else "")
            name = catalog.nearest(prompt) or catalog.nearest(catalog.entries[0].name)
            raise fail(key, expected=known, got=prompt, example=f'{key}="a {name}"')
        return catalog.scene(found)

    def named(self, prompt: str) -> list[Entry]:
        """Return the objects that a prompt names, at most eight; none if it names none."""
        return modes(read_catalog(self.folder).matching(prompt))


@dataclass(frozen=True, kw_only=True)
class MeshPrior(ExactPrior):
    """A Gaussian over images of one mesh, whatever the prompt says."""

    path: str
    folder: str | None  # of the objects that the empty prompt allows; None: those that come with cadam3d
    up: Annotated[str, one_of(UPS)]  # the up axis of the file

    def scene(self, prompt: str, key: str = "prompt") -> MeshScene:
        """Return the mesh. Raises ``UserError`` if it cannot be read, or if it has no triangles."""
        return MeshScene([read_object(self.path, "prior.path", self.up)], read_catalog(self.folder).census)
