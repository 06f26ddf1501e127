"""Jobs of a retoucher: what is stored, a result of each kind, and the count of judgements."""

import json
from collections import Counter

import pytest
import torch

from benchmarks.keepers import JUDGED, Job, compare_with_judged, contact_sheet, counted, digest, is_same, jobs, main
from benchmarks.photographs import CHOOSING

RECOLOURED = {
    "photograph": "coffee",
    "what": "the cup blue",
    "edit": "recolor",
    "strokes": [{"paint": "#0040c0", "points": [[0.2, 0.5], [0.3, 0.8]]}],
}


def test_stored_jobs_are_fifty_with_a_photograph_of_one_set_and_forty_of_them_are_judged():
    listed = jobs()
    assert len({job.name for job in listed}) == len(listed) == 50
    assert Counter(job.edit for job in listed)["recolor"] == 24
    assert sum(job.keeper is not None for job in listed) >= 40
    for job in listed:
        assert job.set in ("choosing", "reporting")
        assert bool(job.why) == (job.keeper is False)
        if job.edit in ("recolor", "mask", "defocus", "colorize"):
            assert job.strokes


def test_edits_change_a_photograph_and_the_mask_cuts_its_object_out():
    image = torch.rand(1, 3, 24, 32, generator=torch.Generator().manual_seed(0)) * 0.2
    image[:, 0, 8:16, 10:22] += 0.6
    middle = [{"paint": "in", "points": [[0.45, 0.5], [0.55, 0.5]]}]
    cut = Job.of(1, {"photograph": "coffee", "what": "a square", "edit": "mask", "strokes": middle}).after(image)
    torch.testing.assert_close(cut[..., 11:13, 13:19], image[..., 11:13, 13:19], atol=0.05, rtol=0)
    torch.testing.assert_close(cut[..., :4, :], torch.full_like(cut[..., :4, :], 0.6), atol=0.05, rtol=0)
    preset = Job.of(2, {"photograph": "coffee", "what": "clear", "edit": "preset", "preset": "clear"})
    assert preset.recipe.steps[0]["alpha"] == (1.5, 1.5, 1.5, 1.0)
    recoloured = Job.of(3, RECOLOURED | {"strokes": [middle[0] | {"paint": "#0040c0"}]})
    assert (recoloured.after(image) - image)[:, 2, 10:14, 12:20].mean() > 0.1
    assert torch.equal(recoloured.marked(image)[..., :4, :], image[..., :4, :])


def test_parameters_of_a_job_are_those_of_its_edit():
    assert Job.of(1, RECOLOURED | {"parameters": {"extent": "object"}}).recipe.steps[0]["extent"] == "object"
    with pytest.raises(ValueError, match="shrink"):
        Job.of(1, RECOLOURED | {"parameters": {"shrink": 1}})


def test_count_names_what_is_not_kept(capsys):
    kept, lost = Job.of(1, RECOLOURED | {"keeper": True}), Job.of(2, RECOLOURED | {"keeper": False, "why": "a rim"})
    assert "kept 1 of 2, at least 85%: FALLS SHORT" in counted([kept, lost])
    assert "02-coffee-recolor: a rim" in counted([kept, lost])
    assert "kept 1 of 1, at least 85%: holds" in counted([kept])
    assert "kept 1 of 1, at least 85%: holds\n\n03-coffee-recolor: not judged" in counted([kept, Job.of(3, RECOLOURED)])
    judged = [job.keeper for job in jobs() if job.keeper is not None]
    few = sum(judged) < 0.85 * len(judged)
    assert main(["--count"]) == few
    assert f"of {len(judged)}, at least 85%: {'FALLS SHORT' if few else 'holds'}" in capsys.readouterr().out


def test_only_the_jobs_that_are_asked_for_are_counted(capsys):
    listed = jobs()
    kept, lost = (next(job for job in listed if job.keeper is keeper) for keeper in (True, False))
    assert main(["--count", "--only", str(kept.number)]) == 0
    assert "kept 1 of 1, at least 85%: holds" in capsys.readouterr().out
    assert main(["--count", "--only", str(lost.number)]) == 1
    assert f"kept 0 of 1, at least 85%: FALLS SHORT\n\n{lost.name}: {lost.why}\n" in capsys.readouterr().out
    own = [job for job in listed if job.set == "reporting" and job.keeper is not None]
    main(["--count", "--set", "reporting"])
    out = capsys.readouterr().out
    assert f"kept {sum(job.keeper for job in own)} of {len(own)}" in out
    assert "choosing" not in out
    with pytest.raises(SystemExit):
        main(["--count", "--only", "51"])
    assert "no job" in capsys.readouterr().err


def test_contact_sheet_has_a_tile_for_every_result():
    sheet = contact_sheet([torch.zeros(1, 3, 30, 40), torch.zeros(1, 3, 60, 20)])
    assert sheet.shape == (1, 3, 200, 1500)
    assert sheet[..., :200, 400:].mean() > 0.8


def test_photographs_of_scikit_image_need_no_folder():
    job = next(job for job in jobs() if job.photograph in CHOOSING)
    assert job.before(None).shape[1] == 3


def test_results_that_have_changed_since_they_were_judged_are_named(tmp_path, capsys):
    assert {job.name for job in jobs() if job.keeper is not None} == json.loads(JUDGED.read_text()).keys()
    result, file = torch.rand(1, 3, 60, 90, generator=torch.Generator().manual_seed(0)), tmp_path / "judged.json"
    file.write_text("{}")
    compare_with_judged({"a": digest(result)}, file, store=False)
    assert capsys.readouterr().out == "a: the result has changed since it was judged: look again\n"
    compare_with_judged({"a": digest(result)}, file, store=True)
    compare_with_judged({"a": digest((result * 255).round() / 255)}, file, store=False)
    assert capsys.readouterr().out == ""
    tinted = result.clone()
    tinted[:, 2, 10:14, 20:24] += 0.3
    assert not is_same(digest(tinted), digest(result))
