"""Where does a law fail, how rare is that, and which quantity is to blame?

`probe` tries one law at points of a domain's unit cube and says how bad each trial was; `rare`
estimates small probabilities of failure, `attack` searches for failures of many kinds, `sobol`
shares the blame among the drawn quantities, and `regress` tries a law in worlds that were hard.
`gallery` draws maps of what a sweep lost.
"""
