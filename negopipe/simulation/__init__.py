"""The rules of the driving game: state, geometry, road, tasks, perception, dynamics, collisions, simulator."""
