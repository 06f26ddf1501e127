"""The picture of a page at rest: what a saved file would show, in place of the preview."""

import asyncio
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Protocol

from torch import Tensor

from nlfilter_torch.core.progress import Progress
from nlfilter_torch.photo.app.work import Interruptible, OutdatedError, Run, Start
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.picture.sampling import Report

QUIET = 1.0  # seconds without a change, after which the whole photograph is edited


class Reduced(Protocol):
    """The session of a photograph, as far as its reduced picture is concerned."""

    recipe: Recipe

    @property
    def is_reduced(self) -> bool:
        """Whether the preview has fewer pixels than the photograph."""

    def at_rest(self, recipe: Recipe, report: Report) -> Tensor:
        """The photograph under an edit, reduced to the size of the preview."""


class AtRest:
    """Replaces the preview by the photograph under the edit, reduced, once nothing has changed for a second.

    ``wanted`` says whether a session and its current edit are what the page shows as a preview, ``show`` shows the
    result.
    """

    def __init__(
        self, run: Run, start: Start, wanted: Callable[[Reduced], bool], show: Callable[[Tensor], None]
    ) -> None:
        self._run, self._start, self._wanted, self._show = run, start, wanted, show
        self._working = False
        self._again: Reduced | None = None

    def drawn(self, session: Reduced) -> None:
        """Start over, since the preview of a session has been drawn."""
        if session.is_reduced and session.recipe.acting:
            self._again = session
            if not self._working:
                self._start(self._work())

    async def _work(self) -> None:
        self._working = True
        try:
            while self._again is not None:
                session, self._again = self._again, None
                await asyncio.sleep(QUIET)
                with suppress(OutdatedError):
                    await self._edit(session, session.recipe)
        finally:
            self._working = False

    def _is_outdated(self, session: Reduced, recipe: Recipe) -> bool:
        return self._again is not None or session.recipe.effect != recipe.effect or not self._wanted(session)

    async def _edit(self, session: Reduced, recipe: Recipe) -> None:
        progress = Progress()
        report = Interruptible(progress, partial(self._is_outdated, session, recipe))
        report("Full size", 0, 1)
        picture = await self._run("Full size", partial(session.at_rest, recipe, report), progress)
        report("Full size", 1, 1)
        self._show(picture)
