------------------------------ MODULE settling ------------------------------
(* An RC and the programs that touch its device past it: never two of them at once.

   ownership.tla says who holds an RC. Here one RC begins one hold after the other, each direct, and each ends in any
   way: by its client's release, or by its time, its lease or an RCM, which are all one to it. A message may arrive at
   any time after it was sent, or never, in any order. The RC may be killed and start anew, knowing no more than its
   file. Time goes in steps, without end, by one clock: what clocks run apart is the difference of Settle and Grace.
   Times are kept as what is left of them.

   GUARDS names the guards that are in force, as in docs/promises/guards.md: taking one out must break `Alone`. *)
EXTENDS Integers, FiniteSets

CONSTANTS
    MaxHold,    \* holds are 1 .. MaxHold
    Lease,      \* for which a confirmation may be relied on, from when it was sent
    Settle,     \* from `leaving` on, the program is gone within it
    Grace,      \* from the end that a client heard of, or else of what it relies on, to SIGKILL
    GUARDS

ASSUME Grace < Settle

Holds == 1 .. MaxHold
On(guard) == guard \in GUARDS
Never == -(Lease + Settle + 1)
Max(a, b) == IF a > b THEN a ELSE b
Min(a, b) == IF a < b THEN a ELSE b

VARIABLES
    hold,       \* the one that the RC is in, or 0
    latest,     \* the last that it was ever in
    goneIn,     \* [Holds -> time]: until then its program may be there, as the RC knows; 0: it is gone, or never was
    noted,      \* the RC's file: its last holder may be direct
    blind,      \* for how long an RC that started anew settles
    answered,   \* [Holds -> time]: for how long the newest confirmation is good that the RC has answered, or Never
    sure,       \* [Holds -> time]: the same, of those whose answer has arrived
    over,       \* [Holds -> time]: minus the time since the client heard of the end, or Never
    running,    \* holds whose program runs
    left        \* those whose program is gone for good, as its client or guardian says

rc == <<hold, latest, goneIn, noted, blind>>
client == <<answered, sure, over, running, left>>
vars == <<rc, client>>

Init ==
    /\ hold = 0 /\ latest = 0 /\ noted = FALSE /\ blind = 0
    /\ goneIn = [h \in Holds |-> 0]
    /\ answered = [h \in Holds |-> Never] /\ sure = [h \in Holds |-> Never] /\ over = [h \in Holds |-> Never]
    /\ running = {} /\ left = {}

(* In so much time the guardian has killed it, whatever happens to its client. *)
Deadline(h) == IF ~ On("deadline") THEN 1 ELSE (IF over[h] = Never THEN sure[h] ELSE Min(sure[h], over[h])) + Grace

(* What is longer ago than a grace is all the same. *)
Sooner(time) == IF time = Never THEN Never ELSE Max(time - 1, -Grace)

Tick ==
    /\ \A h \in running : Deadline(h) > 0
    /\ goneIn' = [h \in Holds |-> Max(goneIn[h] - 1, 0)] /\ blind' = Max(blind - 1, 0)
    /\ answered' = [h \in Holds |-> Sooner(answered[h])]
    /\ sure' = [h \in Holds |-> Sooner(sure[h])]
    /\ over' = [h \in Holds |-> Sooner(over[h])]
    /\ UNCHANGED <<hold, latest, noted, running, left>>

-----------------------------------------------------------------------------
(* The RC *)

(* It hears of a grant: the next one, or the last once more after it started anew. *)
Begin(h) ==
    /\ h >= latest /\ h <= latest + 1 /\ h # hold
    /\ hold' = h /\ latest' = h
    /\ UNCHANGED <<goneIn, noted, blind, client>>

End ==
    /\ hold # 0
    /\ hold' = 0
    /\ UNCHANGED <<latest, goneIn, noted, blind, client>>

(* Former programs may touch the device yet. *)
Settles(h) == On("settling") /\ (blind > 0 \/ \E g \in Holds : g < h /\ goneIn[g] > 0)

(* It answers a confirmation that was sent `ago`, when its client had not heard of an end. *)
Confirm(h, ago) ==
    /\ hold = h /\ ~ Settles(h) /\ h \notin left
    /\ over[h] # Never => ago >= -over[h]
    /\ noted' = TRUE
    /\ goneIn' = [goneIn EXCEPT ![h] = IF @ = 0 \/ On("confirmed") THEN Lease + Settle ELSE @]
    /\ answered' = [answered EXCEPT ![h] = IF over[h] = Never THEN Max(@, Lease - ago) ELSE @]
    /\ UNCHANGED <<hold, latest, blind, sure, over, running, left>>

HearLeaving(h) ==
    /\ over[h] # Never /\ goneIn[h] > Settle
    /\ goneIn' = [goneIn EXCEPT ![h] = Settle]
    /\ UNCHANGED <<hold, latest, noted, blind, client>>

HearLeft(h) ==
    /\ h \in left /\ goneIn[h] # 0
    /\ goneIn' = [goneIn EXCEPT ![h] = 0]
    /\ UNCHANGED <<hold, latest, noted, blind, client>>

Forget ==
    /\ noted /\ blind = 0 /\ \A h \in Holds : goneIn[h] = 0
    /\ noted' = FALSE
    /\ UNCHANGED <<hold, latest, goneIn, blind, client>>

Restart ==
    /\ hold' = 0
    /\ goneIn' = [h \in Holds |-> 0]
    /\ blind' = IF noted /\ On("remembered") THEN Lease + Settle ELSE 0
    /\ UNCHANGED <<latest, noted, client>>

-----------------------------------------------------------------------------
(* The client of a hold, its program, and that one's guardian *)

HearAnswer(h) ==
    /\ sure[h] < answered[h] /\ over[h] = Never
    /\ sure' = [sure EXCEPT ![h] = answered[h]]
    /\ UNCHANGED <<rc, answered, over, running, left>>

Enter(h) ==
    /\ sure[h] # Never /\ over[h] = Never /\ h \notin running \cup left
    /\ Deadline(h) > 0
    /\ running' = running \cup {h}
    /\ UNCHANGED <<rc, answered, sure, over, left>>

(* It hears of the end of its hold, or judges so: no answer makes a difference any more. *)
HearEnd(h) ==
    /\ over[h] = Never /\ h <= latest
    /\ over' = [over EXCEPT ![h] = 0] /\ answered' = [answered EXCEPT ![h] = Never]
    /\ UNCHANGED <<rc, sure, running, left>>

(* The program ends, of its own accord or killed: who saw that may say so. *)
Leave(h) ==
    /\ h \in running \/ (over[h] # Never /\ h \notin left)
    /\ running' = running \ {h} /\ left' = left \cup {h}
    /\ answered' = [answered EXCEPT ![h] = Never] /\ sure' = [sure EXCEPT ![h] = Never]
    /\ over' = [over EXCEPT ![h] = -Grace]
    /\ UNCHANGED rc

-----------------------------------------------------------------------------
Next ==
    \/ Tick \/ End \/ Forget \/ Restart
    \/ \E h \in Holds :
        \/ Begin(h) \/ HearLeaving(h) \/ HearLeft(h) \/ HearAnswer(h) \/ Enter(h) \/ HearEnd(h) \/ Leave(h)
        \/ \E ago \in 0 .. Lease + Grace : Confirm(h, ago)

Spec == Init /\ [][Next]_vars

(* What the RC is for: no two programs touch its device at once. *)
Alone == Cardinality(running) <= 1
=============================================================================
