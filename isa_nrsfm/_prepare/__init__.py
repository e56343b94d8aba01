"""Tables made ready for a fit: checked, scaled, completed, robust."""
