"""Foundation: errors, frozen arrays, frames, the Earth. It knows nothing of the rest."""
