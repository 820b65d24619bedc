"""What surrounds a plant: references, rewards, sensor, observation, policies, the closed loop, the environment."""
