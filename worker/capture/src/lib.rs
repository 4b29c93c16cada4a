//! Importers, images, masks, preflight and the held-out split.
