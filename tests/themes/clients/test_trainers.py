"""The layer in models of Lightning and Hugging Face, and in the workers of a DataLoader."""

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn
from torch.utils.data import DataLoader, Dataset, TensorDataset

from nlfilter_torch import NonlocalFilter
from tests.layers import ALPHA, OPTIONS, image


@pytest.mark.client("Lightning", "trains; a training that was stopped goes on where it was")
@pytest.mark.filterwarnings("ignore")  # of Lightning, which advises on workers and logging
def test_lightning_resumes(tmp_path: Path) -> None:
    lightning = pytest.importorskip("pytorch_lightning")

    class Model(lightning.LightningModule):  # type: ignore[name-defined, misc]
        def __init__(self) -> None:
            super().__init__()
            self.layer = NonlocalFilter(ALPHA, learn=("alpha", "photometric_bandwidth"), **OPTIONS)

        def training_step(self, batch: Any, _: int) -> torch.Tensor:
            return (self.layer(batch[0]) - batch[1]).square().mean()

        def configure_optimizers(self) -> torch.optim.Optimizer:
            return torch.optim.Adam(self.parameters(), lr=0.1)

    def fit(epochs: int, **options: Any) -> Any:
        quiet = {"logger": False, "enable_progress_bar": False, "enable_model_summary": False}
        trainer = lightning.Trainer(
            max_epochs=epochs, accelerator="cpu", default_root_dir=tmp_path, enable_checkpointing=False, **quiet
        )
        trainer.fit(Model(), DataLoader(TensorDataset(image(0), image(1)), batch_size=1), **options)
        return trainer

    at_once, first = fit(2), fit(1)
    first.save_checkpoint(tmp_path / "first.ckpt")
    resumed = fit(2, ckpt_path=tmp_path / "first.ckpt")
    assert not torch.equal(at_once.model.layer.alpha, first.model.layer.alpha)
    for name, value in at_once.model.state_dict().items():
        torch.testing.assert_close(resumed.model.state_dict()[name], value)


@pytest.mark.client("Hugging Face's `PyTorchModelHubMixin`", "saves and loads options and parameters")
def test_a_model_of_the_hub_is_loaded_with_its_options(tmp_path: Path) -> None:
    hub = pytest.importorskip("huggingface_hub")

    class Shared(nn.Module, hub.PyTorchModelHubMixin):  # type: ignore[name-defined, misc]
        def __init__(self, num_landmarks: int = 30, learn: tuple[str, ...] = ()) -> None:
            super().__init__()
            self.layer = NonlocalFilter(num_landmarks=num_landmarks, learn=learn, photometric_bandwidth=0.2)

        def forward(self, picture: torch.Tensor) -> torch.Tensor:
            return self.layer(picture)

    model = Shared(num_landmarks=20, learn=("alpha", "photometric_bandwidth"))
    with torch.no_grad():
        model.layer.sliders.alpha.mul_(2)
    model.save_pretrained(tmp_path / "model")
    loaded = Shared.from_pretrained(tmp_path / "model")
    assert loaded.layer.affinity.num_landmarks == 20
    torch.testing.assert_close(loaded(image()), model(image()), atol=0, rtol=0)


class Filtered(Dataset[torch.Tensor]):
    """Pictures that are filtered when they are loaded."""

    def __len__(self) -> int:
        return 2

    def __getitem__(self, index: int) -> torch.Tensor:
        with torch.no_grad():
            return NonlocalFilter(ALPHA, **OPTIONS)(image(index, batch=1)[0])


@pytest.mark.client("`DataLoader`", "workers build operators")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_workers_of_a_loader_build_operators() -> None:
    pictures = Filtered()
    result = list(DataLoader(pictures, num_workers=1, batch_size=None))
    torch.testing.assert_close(torch.stack(result), torch.stack([pictures[0], pictures[1]]))
