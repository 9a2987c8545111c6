"""The stages of a run. Report needs evaluate, replay needs evaluate, evaluate needs a checkpoint (as train writes it);
the others need no other stage."""
