"""Tests of the models that an agent can learn."""
