"""The driving game itself: state, geometry, road, tasks, perception and the batched simulator."""
