"""The policies that the learned one is compared with: what an engineer would do in its place, and the limits."""
