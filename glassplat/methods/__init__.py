"""Methods: how each trains, and with which options."""
