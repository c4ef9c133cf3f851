----------------------------- MODULE ownership -----------------------------
(* Who owns what in zscout: terms, promises, grants, publications, adoption, hold leases, hand-over, release.

   A reign is one term of one leader. All that it publishes, and every answer it gives about its state, is one
   step of its history; whatever of that ever was may arrive anywhere at any later time, again, or never. So
   loss, repetition, delay and reordering of messages need no actions of their own, and a partition is a time
   in which nothing arrives. Any number of reigns may go on side by side: one that is over is one of which
   nothing more is heard. Time is not modelled: a lease may be over at any moment.

   Each RC is one device with one instance. It is exclusive; capacities and votes do not matter here. A command
   may be sent under any grant that ever was, by whoever believes in it.

   GUARDS names the guards of the protocol that are in force: taking one out must break an invariant
   (docs/promises/guards.md lists which). *)
EXTENDS Naturals, Sequences, FiniteSets

CONSTANTS
    Clients,
    RCs,
    Needs,      \* [Clients -> sets of RCs]: the gangs of which any one meets what each client asks for
    MaxTerm,    \* terms are 1 .. MaxTerm; 0 is before all
    MaxSeq,     \* steps of one reign in which grants come and go
    MaxJoin,    \* its steps in all: in the rest it takes in RCs and repeats itself
    Losses,     \* whether a leader may lose sight of an RC
    None,
    GUARDS

Terms == 1 .. MaxTerm
Guards == {"fence", "above", "older", "ended", "grant", "whole", "over", "known"}
ASSUME GUARDS \subseteq Guards

On(guard) == guard \in GUARDS

(* A grant is [term, seq, client, rcs]: which step of which reign granted it, to whom, and the gang. *)
Newer(t, s, known) == t > known[1] \/ (t = known[1] /\ s > known[2])
Older(g, h) == Newer(h.term, h.seq, <<g.term, g.seq>>)

VARIABLES
    answers,    \* [Terms -> [RCs -> set of holds]]: what each RC answered to the promise of this term
    joined,     \* [Terms -> SUBSET RCs]: whom the reign may grant
    history,    \* [Terms -> Seq([seq, table, named])]: who holds each RC, and which RCs that step named
    heard,      \* [RCs -> <<term, seq>>]: the newest that it obeyed, or promised
    hold,       \* [RCs -> hold]
    ended,      \* [RCs -> set of grants that ended there]
    obeyed      \* [RCs -> hold]: under which its device was commanded last

leaders == <<joined, history>>
vars == <<answers, joined, history, heard, hold, ended, obeyed>>

Free == [r \in RCs |-> None]

Init ==
    /\ answers = [t \in Terms |-> [r \in RCs |-> {}]]
    /\ joined = [t \in Terms |-> {}]
    /\ history = [t \in Terms |-> <<>>]
    /\ heard = [r \in RCs |-> <<0, 0>>]
    /\ hold = Free
    /\ ended = [r \in RCs |-> {}]
    /\ obeyed = Free

Leads(t) == history[t] # <<>>
Last(t) == history[t][Len(history[t])]
Now(t) == IF Leads(t) THEN Last(t).seq ELSE 0
Table(t) == Last(t).table
Says(t, table, named) ==
    history' = [history EXCEPT ![t] = Append(@, [seq |-> Now(t) + 1, table |-> table, named |-> named])]

-----------------------------------------------------------------------------
(* Reigns *)

(* An RC promises to obey nothing older than this term, and answers what it holds. *)
Promise(r, t) ==
    /\ r \notin joined[t]
    /\ On("above") => heard[r][1] <= t
    /\ IF On("fence") \/ ~ On("above")
       THEN heard' = [heard EXCEPT ![r] = IF heard[r][1] = t THEN heard[r] ELSE <<t, 0>>]
       ELSE UNCHANGED heard
    /\ answers' = [answers EXCEPT ![t][r] = @ \cup {hold[r]}]
    /\ answers' # answers \/ heard' # heard
    /\ UNCHANGED <<joined, history, hold, ended, obeyed>>

(* All that it ever said of this RC. *)
Held(r, t) == {history[t][i].table[r] : i \in DOMAIN history[t]}

(* What this reign had in a table, and has no longer, it has ended. *)
Ended(t, g) == \E i \in DOMAIN history[t] : \E r \in RCs : history[t][i].table[r] = g /\ Table(t)[r] # g

(* It takes in the RCs of S by these answers, at its beginning or later: a hold of earlier terms goes on if all RCs
   of its gang say so, it was not ended here, and its client has no other here, nor a newer one in
   these answers. All else that they hold ends, and so do the holds of `lost`: their clients are gone, or do not ask
   for them. *)
TakeIn(t, S, said, lost) ==
    LET before == IF Leads(t) THEN Table(t) ELSE Free
        goes_on(g) ==
            /\ g.term < t /\ g \notin lost
            /\ On("whole") => g.rcs \subseteq S /\ \A r \in g.rcs : said[r] = g
            /\ On("over") => ~ Ended(t, g)
            /\ On("known") => \A r \in RCs :
                /\ before[r] # None => before[r].client # g.client
                /\ (r \in S /\ said[r] # None /\ said[r].client = g.client) => ~ Older(g, said[r])
        table == [r \in RCs |->
            IF r \notin S THEN before[r] ELSE IF said[r] # None /\ goes_on(said[r]) THEN said[r] ELSE None]
    IN /\ Now(t) < MaxJoin /\ (S # {} \/ ~ Leads(t))
       /\ \A r \in S : r \notin joined[t] /\ said[r] \in answers[t][r]
       /\ Says(t, table, S)
       /\ joined' = [joined EXCEPT ![t] = @ \cup S]
       /\ UNCHANGED <<answers, heard, hold, ended, obeyed>>

Join(t) == \E S \in SUBSET (RCs \ joined[t]) : \E said \in [S -> UNION {answers[t][r] : r \in S}] :
    \E lost \in SUBSET ({said[r] : r \in S} \ {None}) : TakeIn(t, S, said, lost)

Step(t, table, named) ==
    /\ Leads(t) /\ Now(t) < MaxSeq
    /\ Says(t, table, named)
    /\ UNCHANGED <<answers, heard, hold, ended, obeyed>>

Of(t, c) == {r \in RCs : Table(t)[r] # None /\ Table(t)[r].client = c}

(* A grant, of all or nothing; those who hold one of its RCs are preempted in the same step. *)
Grant(t, c, gang) ==
    /\ Leads(t) /\ gang \subseteq joined[t] /\ Of(t, c) = {}
    /\ LET g == [term |-> t, seq |-> Now(t) + 1, client |-> c, rcs |-> gang]
           out == {Table(t)[r].client : r \in {q \in gang : Table(t)[q] # None}}
           named == gang \cup UNION {Of(t, d) : d \in out}
       IN Step(t, [r \in RCs |-> IF r \in gang THEN g ELSE IF r \in named THEN None ELSE Table(t)[r]], named)
    /\ UNCHANGED joined

(* A hold ends: by its time, or by its client. *)
Revoke(t, c) ==
    /\ Leads(t) /\ Of(t, c) # {}
    /\ Step(t, [r \in RCs |-> IF r \in Of(t, c) THEN None ELSE Table(t)[r]], Of(t, c))
    /\ UNCHANGED joined

(* An RC goes, as far as the leader sees: the whole gang of its holder ends. It may be taken in again. *)
Lose(t, r) ==
    /\ Losses /\ Leads(t) /\ r \in joined[t]
    /\ LET out == IF Table(t)[r] = None THEN {} ELSE Of(t, Table(t)[r].client)
       IN Step(t, [q \in RCs |-> IF q \in out THEN None ELSE Table(t)[q]], out \ {r})
    /\ joined' = [joined EXCEPT ![t] = @ \ {r}]

(* An RC reports something else than this reign last said: it is told again. (The number that this takes is
   left out: it changes nothing but the order, and there would be no end of them.) *)
Repeat(t, r) ==
    /\ Leads(t) /\ r \in joined[t] /\ r \notin Last(t).named
    /\ heard[r] = <<t, Now(t)>> /\ hold[r] # Table(t)[r] /\ Table(t)[r] \notin ended[r]
    /\ history' = [history EXCEPT ![t][Len(history[t])].named = @ \cup {r}]
    /\ UNCHANGED <<answers, joined, heard, hold, ended, obeyed>>

(* The same RCs go on with another client, under a new grant. *)
HandOver(t, c, d) ==
    /\ Leads(t) /\ Of(t, c) # {} /\ Of(t, d) = {}
    /\ LET g == [term |-> t, seq |-> Now(t) + 1, client |-> d, rcs |-> Of(t, c)]
       IN Step(t, [r \in RCs |-> IF r \in Of(t, c) THEN g ELSE Table(t)[r]], Of(t, c))
    /\ UNCHANGED joined

-----------------------------------------------------------------------------
(* Resource controllers *)

Becomes(r, next) ==
    LET begins == IF next # None /\ On("ended") /\ next \in ended[r] THEN None ELSE next
    IN /\ hold' = [hold EXCEPT ![r] = begins]
       /\ ended' = [ended EXCEPT ![r] = IF hold[r] # None /\ hold[r] # begins THEN @ \cup {hold[r]} ELSE @]

Hearing(r, t, said) ==
    /\ On("older") => ~ Newer(heard[r][1], heard[r][2], <<t, said.seq>>)
    /\ heard' = [heard EXCEPT ![r] = <<t, said.seq>>]

(* It hears a publication. *)
Hear(r, t, said) ==
    /\ Hearing(r, t, said)
    /\ IF r \in said.named THEN Becomes(r, said.table[r]) ELSE UNCHANGED <<hold, ended>>
    /\ <<heard', hold'>> # <<heard, hold>>
    /\ UNCHANGED <<answers, leaders, obeyed>>

(* It reads an answer about the state: that ends nothing. *)
Read(r, t, said) ==
    /\ Hearing(r, t, said)
    /\ IF hold[r] = None THEN Becomes(r, said.table[r]) ELSE UNCHANGED <<hold, ended>>
    /\ <<heard', hold'>> # <<heard, hold>>
    /\ UNCHANGED <<answers, leaders, obeyed>>

(* It hears a heartbeat: how far the reign is, though what was published there was lost. *)
Beat(r, t, said) ==
    /\ Hearing(r, t, said) /\ heard' # heard
    /\ UNCHANGED <<answers, leaders, hold, ended, obeyed>>

(* Its time is over, or no leader was heard for a hold lease. *)
Expire(r) ==
    /\ hold[r] # None
    /\ hold' = [hold EXCEPT ![r] = None]
    /\ ended' = [ended EXCEPT ![r] = @ \cup {hold[r]}]
    /\ UNCHANGED <<answers, leaders, heard, obeyed>>

(* A command is carried out under exactly the grant that the RC holds, whatever its sender believes. *)
Command(r) ==
    /\ \E g \in IF On("grant") THEN {hold[r]} ELSE UNION {Held(r, t) : t \in Terms} :
        /\ g # None
        /\ obeyed' = [obeyed EXCEPT ![r] = g]
    /\ obeyed' # obeyed
    /\ UNCHANGED <<answers, leaders, heard, hold, ended>>

-----------------------------------------------------------------------------
Reign(t) ==
    \/ Join(t)
    \/ \E r \in RCs : Promise(r, t) \/ Lose(t, r) \/ Repeat(t, r)
    \/ \E c \in Clients : Revoke(t, c) \/ \E gang \in Needs[c] : Grant(t, c, gang)
    \/ \E c, d \in Clients : c # d /\ HandOver(t, c, d)
    \/ \E i \in DOMAIN history[t] : \E r \in RCs : LET said == history[t][i] IN
        Hear(r, t, said) \/ Read(r, t, said) \/ Beat(r, t, said)

Next == (\E t \in Terms : Reign(t)) \/ \E r \in RCs : Expire(r) \/ Command(r)

Spec == Init /\ [][Next]_vars

(* The same states in fewer steps: one reign after the other.

   Let a step belong to the reign in which it is, and Expire(r) and Command(r) to the one that r heard last. A leader
   takes part in steps of its own reign alone, and an RC that took part in one of a reign takes part in none of an
   earlier reign after it: `fence` and `above` see to promises, `older` to what it hears. So if a step is followed by
   one of an earlier reign, no leader and no RC takes part in both: they may change places, and lead to the same state.
   Each state that Next leads to is so the end of a behaviour in which all steps of a reign come before all of the
   next. Reigns that go on side by side, and their messages that arrive late, are in it as much as in Next: what an
   RC hears of one of them is over when it hears of the next, for this RC, not for others.

   What no step to come can read is forgotten when a reign is passed: what it said and was told, how far each RC
   heard it (all of them count as having heard all), and ended grants that no RC holds: none can answer with them.
   And each hold is commanded as it begins: that changes nothing else, and if it is wrong under some grant after an
   earlier one it is wrong under two that follow one another.

   Without one of the guards that this needs, Next is as it is. *)
Ordered == {"fence", "above", "older", "grant"} \subseteq GUARDS

(* The first reign that some RC may yet hear. *)
Turn == CHOOSE t \in Terms :
    /\ \E r \in RCs : ~ Newer(heard[r][1], heard[r][2], <<t, MaxJoin>>)
    /\ \A u \in 1 .. t - 1 : \A r \in RCs : Newer(heard[r][1], heard[r][2], <<u, MaxJoin>>)

Pass(t) ==
    /\ t < MaxTerm
    /\ answers' = [answers EXCEPT ![t] = [r \in RCs |-> {}]]
    /\ joined' = [joined EXCEPT ![t] = {}]
    /\ history' = [history EXCEPT ![t] = <<>>]
    /\ heard' = [r \in RCs |-> <<t, MaxJoin + 1>>]
    /\ ended' = [r \in RCs |-> {g \in ended[r] : \E q \in RCs : hold[q] = g}]
    /\ UNCHANGED <<hold, obeyed>>

Uncommanded == {r \in RCs : hold[r] # None /\ obeyed[r] # hold[r]}

NextOrdered ==
    IF ~ Ordered THEN Next
    ELSE IF Uncommanded # {} THEN \E r \in Uncommanded : Command(r)
    ELSE Reign(Turn) \/ Pass(Turn) \/ \E r \in RCs : heard[r][1] = Turn /\ heard[r][2] <= MaxJoin /\ Expire(r)

SpecOrdered == Init /\ [][NextOrdered]_vars

(* Once there is only the last reign: its questions, publications and repetitions arrive in the end. *)
Fair == \A r \in RCs :
    /\ WF_vars(Promise(r, MaxTerm)) /\ WF_vars(Repeat(MaxTerm, r))
    /\ WF_vars(Leads(MaxTerm) /\ Hear(r, MaxTerm, Last(MaxTerm)))

FairSpec == SpecOrdered /\ Fair /\ WF_vars(Join(MaxTerm))

-----------------------------------------------------------------------------
(* Promises *)

(* A device is never commanded under an older grant after a newer. *)
Fenced == [][\A r \in RCs :
    IF obeyed[r] = None \/ obeyed'[r] = obeyed[r] THEN TRUE ELSE Older(obeyed[r], obeyed'[r])]_vars

(* What has ended does not begin again. *)
NeverAgain == \A r \in RCs : hold[r] \notin ended[r]

(* An RC never goes back in what it obeys. *)
Forward == [][\A r \in RCs : ~ Newer(heard[r][1], heard[r][2], heard'[r])]_vars

(* In what a reign says a hold has all of its RCs, and its client no second one. *)
Whole == \A t \in Terms : Leads(t) =>
    \A r \in RCs : LET g == Table(t)[r] IN
        IF g = None THEN TRUE ELSE \A q \in RCs :
            IF q \in g.rcs THEN Table(t)[q] = g
            ELSE IF Table(t)[q] = None THEN TRUE ELSE Table(t)[q].client # g.client

(* What a reign ended it does not take up again. *)
Final == \A t \in Terms : \A i \in DOMAIN history[t] : \A r \in RCs :
    LET g == history[t][i].table[r] IN
        g # None /\ Table(t)[r] = g => \A j \in i .. Len(history[t]) : history[t][j].table[r] = g

(* Of an RC that obeys no higher term the reign that has taken it in knows what it holds: it said so, or the RC did
   when it was taken in. *)
Known == \A t \in Terms : \A r \in joined[t] :
    IF heard[r][1] > t \/ hold[r] = None THEN TRUE
    ELSE hold[r] \in Held(r, t) \cup answers[t][r]

(* In the end the last reign has taken in every RC, and each of them holds what it says, or has ended just that. *)
Converges == <>[](\A r \in RCs :
    /\ r \in joined[MaxTerm]
    /\ hold[r] = Table(MaxTerm)[r] \/ Table(MaxTerm)[r] \in ended[r])
=============================================================================
