"""The rod itself: parameters, state, elastic law, factories."""
