"""What surrounds a plant: references, rewards, sensor, observation, policies, identification, the environment."""
