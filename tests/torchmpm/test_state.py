"""ParticleState: shapes, selection, branching, files and processes."""

import multiprocessing
import pickle
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scenes import assert_identical, lively, robot

from torchmpm import ParticleState

FIELDS = ("x", "v", "C", "F", "Jp")


def test_at_rest_is_undeformed_and_without_velocity() -> None:
    x = torch.rand(3, 5, 2)
    state = ParticleState.at_rest(x)
    assert torch.equal(state.x, x)
    assert torch.equal(state.v, torch.zeros(3, 5, 2))
    assert torch.equal(state.C, torch.zeros(3, 5, 2, 2))
    assert torch.equal(state.F, torch.eye(2).expand(3, 5, 2, 2))
    assert torch.equal(state.Jp, torch.ones(3, 5))
    assert (state.batch_size, state.num_particles, state.dtype) == (3, 5, torch.float32)
    assert state.device == x.device
    state.F[1, 2].mul_(1.5)  # the fields have memory of their own
    assert state.F.sum() == 2.0 * 15.0 + 1.0


def test_a_saved_state_is_loaded_without_running_code(tmp_path: Path) -> None:
    state = robot(7).step(lively(7), substeps=1)
    torch.save({"state": state}, tmp_path / "state.pt")
    assert_identical(torch.load(tmp_path / "state.pt", weights_only=True)["state"], state)


@pytest.mark.parametrize(
    "index",
    [
        *(0, 2, -1, -3, torch.tensor(1), np.array(-1), np.int64(2)),
        *(slice(1, None), [2, 0], torch.tensor([True, False, True])),
    ],
)
def test_an_index_selects_batch_elements(index: object) -> None:
    """A number keeps a batch of one."""
    state = lively(4, 3)
    for name in FIELDS:
        whole = getattr(state, name)
        assert torch.equal(getattr(state[index], name), whole[index].view(-1, *whole.shape[1:]))


@pytest.mark.parametrize(
    "index",
    [
        *(3, -4, None, "x", torch.tensor(True), torch.tensor(1.5), torch.tensor(3)),
        *(True, False, np.bool_(True), (0, 1), (0,), (slice(None), slice(0, 1)), (slice(None), 0)),
    ],
)
def test_index_that_is_no_batch_element(index: object) -> None:
    with pytest.raises(IndexError):
        lively(4, 3)[index]


def test_clone_is_independent_and_detach_leaves_the_graph() -> None:
    state = lively(4)
    state.clone().x.zero_()
    assert state.x.abs().min() > 0
    linked = replace(state, x=state.x.clone().requires_grad_())
    assert linked.clone().x.requires_grad and not linked.detach().x.requires_grad
    assert linked.detach().x.data_ptr() == linked.x.data_ptr()


def test_to_converts_every_field() -> None:
    single = lively(4).to(torch.float32)
    assert {getattr(single, name).dtype for name in FIELDS} == {torch.float32}
    assert single.to("meta").Jp.device.type == "meta"


#: Installs the check of annotations before anything else is imported, and runs tests.
ANNOTATED = """
import jaxtyping, pytest, sys
with jaxtyping.install_import_hook("torchmpm", "beartype.beartype"):
    options = ["-p", "no:cacheprovider", "-W", "ignore::pytest.PytestAssertRewriteWarning"]
    code = pytest.main([*options, *sys.argv[1:]])
    import torch, torchmpm
assert code == 0
with pytest.raises(jaxtyping.TypeCheckError):
    torchmpm.ParticleState.at_rest(torch.zeros(5, 2)).where(torch.ones(1, 1) > 0, None)
"""


@pytest.mark.slow
def test_annotations_hold_when_they_are_checked() -> None:
    """In a process of its own, because jaxtyping's hook only reaches modules that are not imported yet."""
    files = [str(Path(__file__).with_name(f"test_{name}.py")) for name in ("diagnostics", "solver", "state", "tree")]
    without_lists = ["-k", "not test_a_list_of_bodies_is_copied"]  # which are tuples in the annotations
    subprocess.run([sys.executable, "-c", ANNOTATED, *files, *without_lists], check=True, timeout=600)


def test_a_pickle_is_a_state_and_holds_its_numbers_alone() -> None:
    """Not five times the tensor that all fields are views of, nor the rest of its batch."""
    state = robot(500).step(lively(500, batch=4), substeps=1)
    size = 13 * 500 * state.x.element_size()
    assert len(pickle.dumps(state)) < 4 * size + 4000
    assert len(pickle.dumps(state[1])) < size + 4000
    again = pickle.loads(pickle.dumps(state))
    again.v[..., 0] += 1.0
    assert torch.equal(again.stack()[2], state.v[..., 0] + 1.0)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["spawn", "forkserver"])
def test_a_process_is_started_with_a_state(method: str) -> None:
    """As the workers of a ``DataLoader`` are."""
    if method not in multiprocessing.get_all_start_methods():
        pytest.skip(f"no {method} here")
    state = robot(5).step(lively(5), substeps=1)
    process = multiprocessing.get_context(method).Process(target=repr, args=(state,))
    process.start()
    process.join(120)
    assert process.exitcode == 0
