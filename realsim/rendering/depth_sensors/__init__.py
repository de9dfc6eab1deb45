"""What depth cameras make of exact depth: profiles, a model in disparity space, and its fit."""
