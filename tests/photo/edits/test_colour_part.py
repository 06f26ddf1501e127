"""The part of looks that colour tables carry."""

import torch

from nlfilter_torch.photo.declared.steps import Step
from nlfilter_torch.photo.edits.applying import apply_step
from nlfilter_torch.photo.edits.colour_part import colour_part, colour_table, table_error
from nlfilter_torch.photo.looks.look_filter import colours_of_nodes
from tests.looks import ALPHA, BANDS, BENT, CAT, LOCAL, SEPIA, STRETCH, VIVID

LOOK = Step("look", red=BENT, matrix=SEPIA, saturation=VIVID, amount=0.8)


def test_only_what_depends_on_the_colour_alone_is_in_the_table() -> None:
    whole = LOOK.changed(alpha=ALPHA, bands=BANDS, local=LOCAL, stretch=STRETCH)
    assert colour_part(whole) == LOOK
    assert colour_part(Step("detail")) == Step("look")
    assert torch.equal(colour_table(whole, 5), colour_table(LOOK, 5))


def test_the_table_holds_the_colours_of_its_nodes() -> None:
    nodes = colours_of_nodes(4).view(1, 3, 8, 8)
    torch.testing.assert_close(colour_table(LOOK, 4), apply_step(LOOK, nodes).view(3, 4, 4, 4))


def test_finer_tables_are_more_exact_and_exact_for_curves() -> None:
    curve = Step("look", red=BENT, green=BENT, blue=BENT)
    assert table_error(curve, 33, CAT) < 1e-3
    errors = [table_error(LOOK, nodes, CAT) for nodes in (5, 9, 33)]
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] < 0.5
