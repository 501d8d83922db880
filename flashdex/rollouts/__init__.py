"""Episodes as recorded, rollouts as stored, the ledger and the certificate."""
