"""The safety layer: every plan of the ego is checked before it is driven, and replaced where it does not pass."""
