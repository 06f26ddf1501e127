"""What a page shows of the photograph at full size: the visible part, and at rest what a saved file would show."""

import asyncio
from collections.abc import Callable, Sequence
from contextlib import suppress

import torch
from torch import Tensor

from nlfilter_torch.core.progress import Progress
from nlfilter_torch.photo.app import drawing
from nlfilter_torch.photo.app.dialogs import Tasks
from nlfilter_torch.photo.app.session import Session
from nlfilter_torch.photo.declared.presets import Recipe
from nlfilter_torch.photo.edits.parts import Rectangle
from nlfilter_torch.photo.picture.sampling import Report

QUIET = 1.0  # seconds without a change, after which the whole photograph is edited
CELL = 64  # pixels; pieces consist of squares of that size
PIECE_PIXELS = 1 << 19  # pixels of a piece, at most
KEPT_PIECES = 24_000_000  # pixels of all pieces, at most; invisible pieces are dropped first
LARGEST_VIEW = 40_000_000  # pixels that a page may ask for at once


class OutdatedError(Exception):
    """The edit has changed meanwhile."""


class Interruptible(Progress):
    """Progress that raises OutdatedError at the first report after an edit is outdated.

    Args:
        is_outdated: returns whether the edit of a session is no longer wanted.
        session: of the photograph that is edited.
        recipe: the edit.
    """

    def __init__(self, is_outdated: Callable[[Session, Recipe], bool], session: Session, recipe: Recipe) -> None:
        super().__init__()
        self._is_outdated, self._session, self._recipe = is_outdated, session, recipe

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Report that ``done`` of ``total`` parts of a stage are done."""
        if self._is_outdated(self._session, self._recipe):
            raise OutdatedError
        super().__call__(stage, done, total)


class Closeup:
    """The visible part of a photograph at full size, in pieces that the page lays over the preview.

    ``tell`` runs JavaScript in the page.
    """

    def __init__(self, tasks: Tasks, tell: Callable[[str], object]) -> None:
        self.session: Session | None = None
        self._tasks, self._tell = tasks, tell
        self._view: Rectangle | None = None
        self._recipe = Recipe()
        self._held = False  # a slider is moving: the preview alone follows
        self._working = False
        self._number = 0
        self._pieces: dict[str, tuple[Rectangle, bytes]] = {}  # in the order in which they were made
        self._covered = torch.zeros(0, 0, dtype=torch.bool)  # cells
        self._near: tuple[str, bytes] | None = None  # what is shown approximately, by its name
        self._approaching = False  # whether that is being computed

    def open(self, session: Session) -> None:
        """Show a photograph that was opened."""
        self.session, self._view = session, None
        height, width = session.size
        self._covered = torch.zeros(-(-height // CELL), -(-width // CELL), dtype=torch.bool)
        self._forget()

    @property
    def is_busy(self) -> bool:
        """Whether a part is shown at full size, or a slider is moving."""
        return self._held or self._view is not None

    def look(self, view: Sequence[float] | None) -> None:
        """Show a part, (left, top, right, bottom) in pixels of the photograph, or None for the whole photograph."""
        self._view = None if view is None else self._part(view)
        self.show_nearly()
        self._wake()

    def hold(self) -> None:
        """Show no pieces until :meth:`follow` is called, only nearly what they will be."""
        self._held = True
        if self._pieces:
            self._forget()

    def stop(self) -> None:
        """Stop working, since the page is gone."""
        self._held = True

    def follow(self) -> None:
        """Show the current edit of the session."""
        self._held = False
        if self.session is not None and self.session.recipe.effect != self._recipe.effect:
            self._forget()
        self._wake()

    def file(self, name: str) -> bytes | None:
        """A piece as a PNG file, or what is nearly that as a JPEG."""
        if self._near is not None and name == self._near[0]:
            return self._near[1]
        return self._pieces[name][1] if name in self._pieces else None

    def original(self, place: str) -> bytes | None:
        """A part of the photograph before the edit as a PNG file; ``place`` is that of :meth:`look`, with commas."""
        try:
            part = self._part([int(number) for number in place.split(",")])
        except ValueError:
            return None
        return None if self.session is None or part is None else drawing.lossless(self.session.developed.original(part))

    def _part(self, view: Sequence[float]) -> Rectangle | None:
        """The part that a page asks for, within the photograph; None if it is empty, too large or not a part."""
        if self.session is None or len(view) != 4:
            return None
        height, width = self.session.size
        left, top, right, bottom = (int(number) for number in view)
        part = Rectangle(range(max(0, top), min(height, bottom)), range(max(0, left), min(width, right)))
        return part if 0 < len(part.rows) * len(part.columns) <= LARGEST_VIEW else None

    def _forget(self) -> None:
        """Forget all pieces, which show another edit."""
        self._covered.zero_()
        if self._pieces or self._near is not None:
            self._pieces, self._near = {}, None
            self._tell("closeup.clear()")

    def _wake(self) -> None:
        if not self._working and self._next() is not None:
            self._tasks.start(self._work())

    async def _work(self) -> None:
        """Make pieces until the visible part is covered."""
        self._working = True
        self._tasks.say(self, "Full size\u2026")
        try:
            while (piece := self._next()) is not None:
                session, part = piece
                recipe = session.recipe
                self._begin(recipe)
                try:
                    report = Interruptible(self._is_outdated, session, recipe)
                    content = await self._tasks.run("Full size", _piece, session, part, recipe, report, progress=report)
                except OutdatedError:
                    continue
                if not self._is_outdated(session, recipe):
                    self._add(part, content)
            if self._near is not None:  # covered
                self._tell(f"closeup.drop('{self._near[0]}')")
                self._near = None
        finally:
            self._working = False
            self._tasks.say(self)

    def show_nearly(self) -> None:
        """Show at once what the visible part will nearly be, below the pieces, if there is none of the edit yet."""
        session, view = self.session, self._view
        if session is None or view is None or self._approaching or bool(self._covered.any()):
            return
        if session.recipe.acting and session.has_drawn(session.recipe):
            self._approaching = True
            self._tasks.start(self._lay_below(session, view, session.recipe))

    async def _lay_below(self, session: Session, view: Rectangle, recipe: Recipe) -> None:
        try:
            content = await self._tasks.run("Full size", _nearly, session, view, recipe)
        finally:
            self._approaching = False
        is_late = view != self._view or session is not self.session or bool(self._covered.any())
        if content is not None and not is_late:
            self._begin(recipe)
            self._number += 1
            self._near = f"near-{self._number}", content
            self._place(self._near[0], view)

    def _is_outdated(self, session: Session, recipe: Recipe) -> bool:
        return self._held or self.session is not session or session.recipe.effect != recipe.effect

    def _begin(self, recipe: Recipe) -> None:
        """Show pieces of an edit from now on."""
        if recipe.effect != self._recipe.effect:
            self._forget()
        self._recipe = recipe

    def _place(self, name: str, part: Rectangle) -> None:
        rows, columns = part.rows, part.columns
        self._tell(f"closeup.add('{name}', {columns.start}, {rows.start}, {columns.stop}, {rows.stop})")

    def _add(self, part: Rectangle, content: bytes) -> None:
        self._number += 1
        name = f"piece-{self._number}"
        self._pieces[name] = (part, content)
        self._cells(part).fill_(True)
        self._place(name, part)
        total = sum(len(p.rows) * len(p.columns) for p, _ in self._pieces.values())
        for old, (other, _) in list(self._pieces.items()):
            if total <= KEPT_PIECES:
                return
            if self._view is not None and not other.meets(self._view):
                del self._pieces[old]
                self._cells(other).fill_(False)
                self._tell(f"closeup.drop('{old}')")
                total -= len(other.rows) * len(other.columns)

    def _cells(self, part: Rectangle) -> Tensor:
        """A view of the cells that a part touches: whether each is covered."""
        rows, columns = (slice(axis.start // CELL, -(-axis.stop // CELL)) for axis in (part.rows, part.columns))
        return self._covered[rows, columns]

    def _next(self) -> tuple[Session, Rectangle] | None:
        """The next piece that is visible but missing, with its session, or None."""
        if self.session is None or self._view is None or self._held:
            return None
        height, width = self.session.size
        block = first_block(~self._cells(self._view), PIECE_PIXELS // CELL**2)
        if block is None:
            return None
        top, left = self._view.rows.start // CELL, self._view.columns.start // CELL
        rows, columns = block
        return self.session, Rectangle(
            range((top + rows.start) * CELL, min((top + rows.stop) * CELL, height)),
            range((left + columns.start) * CELL, min((left + columns.stop) * CELL, width)),
        )


def _piece(session: Session, part: Rectangle, recipe: Recipe, report: Report) -> bytes:
    """A part of the photograph under an edit, as a PNG file."""
    return drawing.lossless(session.part(part, recipe, report))


def _nearly(session: Session, part: Rectangle, recipe: Recipe) -> bytes | None:
    """The same at once, approximately, as a JPEG file; None if that is not possible."""
    picture = session.nearly(part, recipe)
    return None if picture is None else drawing.picture(picture)


def first_block(missing: Tensor, most: int) -> tuple[range, range] | None:
    """Rows and columns of the first block of cells (h, w) that are all missing, of at most about ``most`` cells.

    >>> cells = torch.tensor([[0, 1, 1], [0, 1, 1], [1, 1, 1]], dtype=torch.bool)
    >>> first_block(cells, 100), first_block(cells, 2), first_block(~cells, 100)
    ((range(0, 3), range(1, 3)), (range(0, 1), range(1, 3)), (range(0, 2), range(0, 1)))
    """
    places = missing.nonzero()
    if len(places) == 0:
        return None
    top, left = places[0].tolist()
    row = missing[top, left:]
    width = len(row) if bool(row.all()) else int(row.int().argmin())
    bottom = top + 1
    while bottom < len(missing) and (bottom - top + 1) * width <= most:
        if not bool(missing[bottom, left : left + width].all()):
            break
        bottom += 1
    return range(top, bottom), range(left, left + width)


class AtRest:
    """Replaces the preview by the photograph under the edit, reduced, once nothing has changed for a second.

    ``wanted`` says whether a session and its current edit are what the page shows as a preview, ``show`` shows the
    result.
    """

    def __init__(self, tasks: Tasks, wanted: Callable[[Session], bool], show: Callable[[Tensor], None]) -> None:
        self._tasks, self._wanted, self._show = tasks, wanted, show
        self._working = False
        self._again: Session | None = None

    def drawn(self, session: Session) -> None:
        """Start over, since the preview of a session has been drawn."""
        if session.is_reduced and session.recipe.acting:
            self._again = session
            if not self._working:
                self._tasks.start(self._work())

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

    def _is_outdated(self, session: Session, recipe: Recipe) -> bool:
        return self._again is not None or session.recipe.effect != recipe.effect or not self._wanted(session)

    async def _edit(self, session: Session, recipe: Recipe) -> None:
        report = Interruptible(self._is_outdated, session, recipe)
        report("Full size", 0, 1)
        picture = await self._tasks.run("Full size", session.at_rest, recipe, report, progress=report)
        report("Full size", 1, 1)
        self._show(picture)
