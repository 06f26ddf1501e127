"""Steps of this program are found from pairs of photographs."""

import pytest
import torch

from nlfilter_torch.photo import FittedSteps, Recipe, Step, apply_recipe, apply_step, fit_steps
from nlfilter_torch.photo.look_fitting.own_steps import filters_of_presets
from tests.looks import CAT, CUP, FEW, SEPIA, SUIT, explained, in_bytes

SOFT = Step("detail", alpha=(2.2, 1.6, 1.3, 1.0), threshold=8.0, landmarks=40)


def edited(step: Step, image: torch.Tensor = CAT) -> torch.Tensor:
    return in_bytes(apply_step(step, image))


@pytest.mark.parametrize(
    "step",
    [
        SOFT,
        SOFT.changed(alpha=(0.3, 0.5, 1.2, 1.05), limits="none"),
        Step("tone", contrast=1.3, landmarks=40),
        Step("tone", contrast=0.8, clarity=2.0, limits="none", landmarks=40),
        Step("sharpen"),
    ],
)
def test_a_step_is_found_with_its_parameters_in_8_bits(step: Step) -> None:
    after = edited(step)
    steps = fit_steps([(CAT, after)], step=FEW)
    assert [fitted.edit for fitted in steps.steps] == [step.edit]
    values, limits = steps.steps[0], step["limits"]
    assert values["limits"] == limits or float(after.max()) < 1
    for name in ("alpha", "contrast", "clarity", "amount"):
        if name in [parameter.name for parameter in step.declared]:
            assert values[name] == pytest.approx(step[name], rel=0.05, abs=0.05)
    assert explained(CAT, after, steps.apply(CAT)) > 0.99
    assert steps.left_out > 0.98
    assert Recipe.from_json(steps.to_json(), "it").steps == steps.steps


def test_two_steps_are_found_in_their_order() -> None:
    recipe = Recipe((Step("tone", contrast=1.25, landmarks=40), Step("sharpen", amount=3.0)))
    after = in_bytes(apply_recipe(recipe, CAT))
    steps = fit_steps([(CAT, after)], step=FEW)
    assert Recipe(steps.steps) == recipe
    assert explained(CAT, after, steps.apply(CAT)) > 0.99


def test_filters_of_presets_are_tried() -> None:
    assert (("bandwidth", 40.0),) in filters_of_presets()
    step = Step("detail", alpha=(0.1, 0.4, 1.0, 1.0), bandwidth=8.0, spatial_bandwidth="none", landmarks=100)
    steps = fit_steps([(SUIT, edited(step, SUIT))])
    assert dict(steps.steps[0].values).items() >= dict(step.values[1:]).items()


def test_several_pairs_have_the_same_steps() -> None:
    step = Step("tone", contrast=1.2, landmarks=40)
    unchanged = [(SUIT, SUIT)]  # an original among edited pictures says nothing, wherever it is
    steps = fit_steps([*unchanged, *((image, edited(step, image)) for image in (CAT, CUP)), *unchanged], step=FEW)
    assert steps.steps == (step,)
    assert steps.explain_more_than(0.98)
    assert not steps.explain_more_than(steps.left_out)


@pytest.mark.parametrize("kind", ["curve", "colours", "grey", "same"])
def test_edits_of_other_kinds_have_none(kind: str) -> None:
    matrix = torch.tensor(SEPIA).view(3, 3)
    results = {
        "curve": CAT**0.7,
        "colours": torch.einsum("ij,bjhw->bihw", matrix, CAT),
        "grey": CAT.mean(1, keepdim=True).expand(-1, 3, -1, -1),
        "same": CAT,
    }
    assert fit_steps([(CAT, in_bytes(results[kind]))], step=FEW) == FittedSteps()


def test_small_grey_and_dim_pictures() -> None:
    grey = CAT.mean(1, keepdim=True)
    step = Step("tone", contrast=1.4, landmarks=40)
    assert fit_steps([(grey, edited(step, grey))], step=FEW).steps == (step,)
    dim = (0.2 + 0.1 * CAT).double()  # edits see it stretched
    assert fit_steps([(dim, apply_step(step, dim))], step=FEW).steps == (step,)
    for size in (1, 5):
        before = CAT[..., :size, :size]
        assert fit_steps([(before, before * 0.9)], step=FEW) == FittedSteps()


def test_errors() -> None:
    with pytest.raises(ValueError, match="got none; pass"):
        fit_steps([])
    with pytest.raises(ValueError, match="must hold no masks"):
        fit_steps([(CAT, CAT, CAT[:, :1])])
