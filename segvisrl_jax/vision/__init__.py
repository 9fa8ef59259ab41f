"""From a scene and a camera pose to the observation: renderers, and bicubic downsampling."""
