"""Constitutive laws: what a body is made of.

``elastic``, ``von_mises`` and ``snow`` hold one law each, ``base`` what all of them share and ``linalg`` closed forms
for 2x2 matrices. ``body`` gives particles a law.
"""

from torchmpm.materials.base import Material, Value, broadcast_plane, detached_column, lame
from torchmpm.materials.body import Body
from torchmpm.materials.elastic import Elastic
from torchmpm.materials.snow import Snow
from torchmpm.materials.von_mises import VonMises

__all__ = ["Body", "Elastic", "Material", "Snow", "Value", "VonMises", "broadcast_plane", "detached_column", "lame"]
