"""The memory that control process and service process share: rings, mailbox, relay. No locks."""
