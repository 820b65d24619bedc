"""The ids of the environments in Gymnasium. Imports no JAX; `jaxouter.runtime.gymnasium` does when one is made."""

from __future__ import annotations

IDS = {"jaxouter/Pitch-v0": "pitch", "jaxouter/Heaters-v0": "heaters"}
"""Plant of each id."""


def register() -> None:
    """Register the ids, if they are not yet. Gymnasium before 1.0 calls it by the entry point `gymnasium.envs`."""
    from gymnasium.envs import registration

    for name, plant in IDS.items():
        if name not in registration.registry:
            registration.register(
                name,
                entry_point="jaxouter.runtime.gymnasium:OuterLoop",
                vector_entry_point="jaxouter.runtime.gymnasium:OuterLoops",
                kwargs={"plant": plant},
            )
