"""Learners: networks, DDPG, exploration noise, replay. They know nothing of plants."""
