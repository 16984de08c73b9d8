"""Depth lab: data, networks and training for models that refine the depth of a camera.

Needs the extra ``lab`` (``pip install 'depthrig[lab]'``) and Python 3.11. A run is one configuration file:

    python -m depthrig.lab.train tiny.toml

and what it writes (``model.pt``) is read by ``depthrig cdm import``. See ``docs/depth-lab-training.md``. Importing this
package imports neither PyTorch nor anything else of the extra; its modules do.
"""

from __future__ import annotations

from .errors import LabError

__all__ = ["LabError"]
