"""Which files a folder holds."""

from pathlib import Path

from nlfilter_torch.photo.cli.folders import subfolders


def test_subfolders_are_named_but_for_that_of_the_results(tmp_path: Path) -> None:
    for name in ("b", "a", ".hidden", "out"):
        (tmp_path / name).mkdir()
    (tmp_path / "c.png").touch()
    assert subfolders(tmp_path, tmp_path / "out") == ["a", "b"]
