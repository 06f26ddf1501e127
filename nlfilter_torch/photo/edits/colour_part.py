"""The part of a look that is a function of the colour alone, for programs that take colour tables."""

from torch import Tensor

from nlfilter_torch.photo.declared.shared_parameters import LOOK
from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.edits.applying import apply_step
from nlfilter_torch.photo.looks.look_filter import colours_of_nodes

NAMES = ("red", "green", "blue", "matrix", "saturation", "lattice", "amount")


def colour_part(step: Step) -> Step:
    """A look without all that depends on the picture or the surroundings of a pixel; steps of detail have none."""
    if step.edit != LOOK.name:
        return Step(LOOK.name)
    return Step(LOOK.name, **{name: step[name] for name in NAMES})


def colour_table(step: Step, nodes: int) -> Tensor:
    """Colours (3, n, n, n), in float64, under the :func:`colour_part` of a look, by their red, green and blue before.

    They may leave [0, 1].
    """
    colours = colours_of_nodes(nodes).view(1, 3, nodes, nodes * nodes)
    return apply_step(colour_part(step), colours).view(3, nodes, nodes, nodes)


def table_error(step: Step, nodes: int, colours: Tensor) -> float:
    """Root mean squared error in levels of 255 of a table with that many nodes, at colours (B, 3, H, W)."""
    table = colour_table(step, nodes) - colours_of_nodes(nodes)
    shown, exact = (apply_step(part, colours) for part in (Step(LOOK.name, lattice=_flat(table)), colour_part(step)))
    return 255 * float((shown.clamp(0, 1) - exact.clamp(0, 1)).square().mean().sqrt())


def _flat(table: Tensor) -> tuple[float, ...]:
    return tuple(table.flatten().tolist())
