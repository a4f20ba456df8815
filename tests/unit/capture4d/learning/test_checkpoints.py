"""A training that goes on from its checkpoint is the training that never stopped; a wrong file is one line."""

from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from capture4d.errors import InputError
from capture4d.files.atomic import write_bytes
from capture4d.files.tensors import read_tensors, write_tensors
from capture4d.learning.checkpoints import read_checkpoint, write_checkpoint

KIND, COMMAND = "test training", "capture4d learn"


class Training:
    """Two networks, two optimisers and dropout; the second learns later than the first."""

    def __init__(self, width: int = 5, seed: int = 0) -> None:
        torch.manual_seed(seed)
        self.modules = {
            "maker": nn.Sequential(nn.Linear(3, width), nn.BatchNorm1d(width), nn.Dropout(0.5), nn.Linear(width, 2)),
            "critic": nn.Sequential(nn.Conv1d(1, 2, 1), nn.Flatten(), nn.Linear(4, 1)),
        }
        self.optimisers = {name: torch.optim.Adam(each.parameters(), lr=0.01) for name, each in self.modules.items()}
        self.steps = 0

    def go_on(self, steps: int) -> None:
        for _ in range(steps):
            self.steps += 1
            made = self.modules["maker"](torch.randn(4, 3))
            loss = made.square().mean()
            used = ["maker"]
            if self.steps > 2:
                loss, used = loss + self.modules["critic"](made[:, None]).abs().mean(), ["maker", "critic"]
            for name in used:
                self.optimisers[name].param_groups[0]["lr"] *= 0.9
                self.optimisers[name].zero_grad()
            loss.backward()
            for name in used:
                self.optimisers[name].step()

    def save(self, path: Path) -> None:
        tensors = {"queue.first": torch.arange(self.steps)}
        write_checkpoint(
            path, KIND, modules=self.modules, optimisers=self.optimisers, tensors=tensors, note={"steps": self.steps}
        )

    def load(self, path: Path) -> dict[str, Tensor]:
        tensors, note = read_checkpoint(path, KIND, modules=self.modules, optimisers=self.optimisers, command=COMMAND)
        self.steps = note["steps"]
        return tensors


@pytest.mark.parametrize("stop", [0, 1, 2, 4])
def test_a_resumed_training_is_the_same_training_bit_for_bit(tmp_path: Path, stop: int) -> None:
    """Stopped before any step, before the second optimiser's first, and after it."""
    whole = Training()
    whole.go_on(6)
    whole.save(tmp_path / "whole")
    first = Training()
    first.go_on(stop)
    first.save(tmp_path / "stopped")
    torch.manual_seed(99)
    again = Training(seed=7)
    assert again.load(tmp_path / "stopped")["queue.first"].tolist() == list(range(stop))
    again.go_on(6 - stop)
    again.save(tmp_path / "again")
    assert (tmp_path / "again").read_bytes() == (tmp_path / "whole").read_bytes()


def saved(folder: Path) -> Path:
    training = Training()
    training.go_on(3)
    training.save(folder / "last.safetensors")
    return folder / "last.safetensors"


def refused(path: Path, training: Training | None = None) -> str:
    """The reason, from a training that is left as it was."""
    training = training or Training(seed=1)
    before = [each.clone() for module in training.modules.values() for each in module.state_dict().values()]
    random = torch.get_rng_state()
    with pytest.raises(InputError) as error:
        training.load(path)
    after = [each for module in training.modules.values() for each in module.state_dict().values()]
    assert all(torch.equal(a, b) for a, b in zip(before, after, strict=True))
    assert torch.equal(random, torch.get_rng_state())
    message = str(error.value)
    assert message.startswith(f"{path}: ")
    assert message.endswith(f"; to start anew: {COMMAND} ... --overwrite")
    assert "\n" not in message
    return message


def test_what_is_no_checkpoint_is_refused_in_one_line(tmp_path: Path) -> None:
    path = saved(tmp_path)
    assert "weights of another architecture: '0.bias', expected (4,), found (5,)" in refused(path, Training(width=4))
    write_bytes(path, path.read_bytes()[:-10])
    assert "not a readable safetensors file" in refused(path)
    assert "no such file" in refused(tmp_path / "none")
    write_tensors(path, "other training", {}, {})
    assert "expected test training, found other training" in refused(path)


@pytest.mark.parametrize(
    ("name", "change", "said"),
    [
        ("random", None, "expected a whole checkpoint, found one without 'random'"),
        ("random", torch.zeros(3), "'random': expected torch's random state"),
        ("modules.maker.0.weight", None, "another architecture: '0.weight', expected (5, 3), found none"),
        ("modules.critic.9.weight", torch.zeros(2), "another architecture: '9.weight', expected none, found (2,)"),
        ("optimisers.maker.0.exp_avg", None, "expected 18 tensors of the optimiser 'maker', found 17"),
        ("optimisers.critic.1.exp_avg", torch.zeros(3), "'optimisers.critic.1.exp_avg': expected (2,), found (3,)"),
        ("optimisers.maker.77.step", torch.zeros(()), "'optimisers.maker.77.step': expected one of 6 parameters"),
    ],
)
def test_what_is_not_whole_is_named(tmp_path: Path, name: str, change: Tensor | None, said: str) -> None:
    path = saved(tmp_path)
    file = read_tensors(path, KIND)
    kept = {key: value for key, value in file.tensors.items() if key != name}
    changed = {} if change is None else {name: change.numpy()}
    write_tensors(path, KIND, kept | changed, {key: value for key, value in file.note.items() if key != "kind"})
    assert said in refused(path)
