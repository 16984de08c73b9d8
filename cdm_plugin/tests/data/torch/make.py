#!/usr/bin/env python3
"""Writes the checkpoints in this folder: small, of made-up numbers, by the real torch.save. usage: make.py (needs torch)

Every tensor counts up from the number in its comment, so that a reader can be checked without another file.
"""
import collections
import pathlib

import torch

HERE = pathlib.Path(__file__).parent


def count(start, *shape, dtype=torch.float32):
    n = 1
    for d in shape:
        n *= d
    return (torch.arange(n, dtype=torch.float32) + start).to(dtype).reshape(shape)


def save(name, what, **options):
    torch.save(what, HERE / name, **options)


weights = collections.OrderedDict([("head.weight", count(10, 2, 3)), ("head.bias", count(20, 3)), ("token", count(30, 1, 1, 4))])

# As the published checkpoints: wrapped by DistributedDataParallel, beside the state of an optimizer.
module = torch.nn.Linear(3, 2)
with torch.no_grad():
    module.weight.copy_(count(10, 2, 3))
    module.bias.copy_(count(20, 2))
optimizer = torch.optim.AdamW(module.parameters(), lr=1e-4)
module(count(0, 1, 3)).sum().backward()
optimizer.step()
with torch.no_grad():
    module.weight.copy_(count(10, 2, 3))
    module.bias.copy_(count(20, 2))
state = collections.OrderedDict(("module.head." + k, v) for k, v in module.state_dict().items())
state._metadata = module.state_dict()._metadata
save("wrapped.pth", {"model": state, "optimizer": optimizer.state_dict(), "epoch": 7, "best": 0.25, "big": 1 << 80, "none": None, "flags": [True, (1, -2)]})
save("plain.pth", weights)
save("parallel.pth", {"module." + k: v for k, v in weights.items()})
save("without_prefix.pth", {"model": dict(weights)})
save("halves.pth", {"half": count(1, 4, dtype=torch.float16), "brain": count(1, 4, dtype=torch.bfloat16), "double": count(1, 2, dtype=torch.float64), "steps": torch.tensor(5)})
save("parameters.pth", {"p": torch.nn.Parameter(count(5, 2, 2))})
whole = count(0, 4, 3)
save("views.pth", {"whole": whole, "rows": whole[1:3], "empty": torch.zeros(0, 3), "scalar": torch.tensor(2.5), "one": whole[:, :1][2:3]})
save("not_contiguous.pth", {"transposed": count(0, 2, 3).t()})
save("protocol4.pth", weights, pickle_protocol=4)
save("legacy.pth", weights, _use_new_zipfile_serialization=False)
save("no_weights.pth", {"state_dict": dict(weights), "epoch": 3})
save("a_list.pth", [count(0, 2)])
save("whole_module.pth", module)
