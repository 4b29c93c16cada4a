//! EffectsNet, CompositionNet, PatchGAN, warps, losses and the optimiser.
