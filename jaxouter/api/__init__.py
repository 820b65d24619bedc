"""What `import jaxouter` offers: make, learn, load, and the run that they give. The commands call it."""

from jaxouter.api.learning import Stopped, learn, resume
from jaxouter.api.run import Run, RunPolicy, load
from jaxouter.loop.environment import make

__all__ = ["Run", "RunPolicy", "Stopped", "learn", "load", "make", "resume"]
