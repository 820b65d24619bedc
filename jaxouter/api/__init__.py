"""What `import jaxouter` offers: learn, load, and the run that they give. The commands call it."""

from jaxouter.api.learning import Stopped, learn, resume
from jaxouter.api.run import Run, RunPolicy, load

__all__ = ["Run", "RunPolicy", "Stopped", "learn", "load", "resume"]
