"""Success criteria, continuous metrics and certificates: pure functions of tensors."""
