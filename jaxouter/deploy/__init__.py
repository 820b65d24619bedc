"""Where outer loops go: adapters to other tools, each of which needs its extra when it is imported."""
