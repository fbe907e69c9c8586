"""Keeps what was launched once as CUDA graphs, so that later calls of the same shapes launch everything at once."""

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable

import torch
from torch import Tensor

from torchmpm import tree
from torchmpm.native.cuda.programs import Program
from torchmpm.native.tables import Inputs

#: At most so many graphs are kept, and at most this share of the device's memory in their buffers together; the longest
#: unused go first. A call that needs more than that is launched kernel by kernel each time.
KEPT_GRAPHS = 16
KEPT_SHARE = 0.25


class Recorded:
    """A program with inputs of its own, to be played again and again.

    The first call launches kernel by kernel, which compiles the kernels where that is still to be done; the second
    records a graph.
    """

    def __init__(self, build: Callable[[Inputs], Program], inputs: Inputs) -> None:
        with torch.inference_mode(False):  # what is made inside of it cannot be changed outside
            self.inputs = tree.map(torch.empty_like, inputs)
            self.program = build(self.inputs)
        self.graph: torch.cuda.CUDAGraph | None = None
        self.calls = 0

    def run(self, inputs: Inputs) -> tuple[Tensor, ...]:
        """Results for other inputs of the same shapes."""
        for own, given in zip(tree.leaves(self.inputs), tree.leaves(inputs), strict=True):
            own.copy_(given)
        self.calls += 1
        if self.calls == 2:
            graph = torch.cuda.CUDAGraph()
            # Other threads may go on calling CUDA meanwhile.
            with torch.cuda.graph(graph, capture_error_mode="thread_local"):
                self.program.run()
            self.graph = graph
        if self.graph is None:
            self.program.run()
        else:
            self.graph.replay()
        return tuple(t.clone() for t in self.program.results)

    def size(self) -> int:
        """Bytes of all buffers."""
        held = [t for t in vars(self.program).values() if isinstance(t, Tensor)] + tree.leaves(self.inputs)
        return sum(t.numel() * t.element_size() for t in held)


class Cache:
    """Recorded programs by what makes them differ; calls from several threads come one after the other."""

    def __init__(self) -> None:
        self._kept: OrderedDict[Hashable, Recorded] = OrderedDict()
        self._lock = threading.Lock()

    def run(self, key: Hashable, build: Callable[[Inputs], Program], inputs: Inputs, most: float) -> tuple[Tensor, ...]:
        """Results of the program of a key, which is built where there is none yet; ``most`` bytes are kept."""
        with self._lock:
            recorded = self._kept.pop(key, None) or Recorded(build, inputs)
            results = recorded.run(inputs)
            if recorded.size() <= most:  # and did not fail: then its buffers are no longer what a run expects
                self._kept[key] = recorded
            while len(self._kept) > KEPT_GRAPHS or self.size() > most:
                self._kept.popitem(last=False)
            return results

    def size(self) -> int:
        """Bytes of all buffers."""
        return sum(recorded.size() for recorded in self._kept.values())

    def clear(self) -> None:
        """Forget everything."""
        with self._lock:
            self._kept.clear()


cache = Cache()
