import jaxouter  # noqa: F401 - before JAX, of which it keeps messages down
