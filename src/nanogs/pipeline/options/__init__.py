"""Options of a call, checked and as plain data: presets, parameters, targets and views."""
