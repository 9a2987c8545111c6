"""A trained policy outside of the repository: its export, and the check of an export."""
